//! CSV and ASCII tables of numbers.

use std::path::Path;

use super::error::FileError;
use super::table::{Column, Table};

/// Columns of an ASCII table without a header: the challenge's catalogue.
const CHALLENGE_COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// Reads the columns `wanted` (all that are numbers, if `None`).
///
/// The first line that is neither empty nor a `#` comment names the columns if its first field is not
/// a number; otherwise a comment that holds all the names wanted does; otherwise the columns are the
/// challenge's, and further ones are left alone. Fields are separated by commas if the first line of
/// numbers has one, by blanks otherwise. A file without a line of numbers is a table without rows.
pub(super) fn read(path: &Path, wanted: Option<&[&str]>) -> Result<Table, FileError> {
    read_named(path, wanted, &CHALLENGE_COLUMNS)
}

/// The same, with other names for the columns of a table without a header.
pub(super) fn read_named(
    path: &Path,
    wanted: Option<&[&str]>,
    default_names: &[&str],
) -> Result<Table, FileError> {
    let text = super::open::read(path).map_err(FileError::doing(path, "cannot read the table"))?;
    let text = std::str::from_utf8(&text).map_err(|e| {
        FileError::new(
            path,
            format!(
                "this is not a text table: byte {} is not UTF-8",
                e.valid_up_to() + 1
            ),
        )
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut comments = Vec::new();
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(k, line)| (k + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty())
        .peekable();
    while let Some((_, line)) = lines.next_if(|(_, line)| line.starts_with('#')) {
        comments.push(line.trim_start_matches('#').trim());
    }
    let header = lines
        .next_if(|(_, line)| {
            let first = fields(line, line.contains(',')).next();
            first.is_some_and(|field| field.parse::<f64>().is_err())
        })
        .map(|(_, line)| line);
    let data = lines.peek().map(|(_, line)| *line);
    // Where there is no line of numbers, the header tells the separator.
    let commas = data.or(header).is_some_and(|line| line.contains(','));
    let (names, named) = match header {
        Some(line) => (split_names(line), true),
        None => {
            let fits = |names: &Vec<String>| match wanted {
                Some(wanted) => wanted.iter().all(|w| names.iter().any(|n| n == w)),
                None => data.is_some_and(|line| fields(line, commas).count() == names.len()),
            };
            // The last comment that can be a header is one.
            match comments
                .iter()
                .rev()
                .map(|line| split_names(line))
                .find(fits)
            {
                Some(names) => (names, true),
                None => (owned(default_names), false),
            }
        }
    };
    let places: Vec<usize> = match wanted {
        Some(wanted) => wanted
            .iter()
            .map(|name| {
                names.iter().position(|own| own == name).ok_or_else(|| {
                    FileError::new(
                        path,
                        format!(
                            "there is no column `{name}`; columns found: {}",
                            names.join(", ")
                        ),
                    )
                })
            })
            .collect::<Result<_, _>>()?,
        None => (0..names.len()).collect(),
    };
    for &place in &places {
        if names.iter().filter(|name| **name == names[place]).count() > 1 {
            let message = format!("there are two columns named `{}`", names[place]);
            return Err(FileError::new(path, message));
        }
    }
    let slot: Vec<Option<usize>> = (0..names.len())
        .map(|column| places.iter().position(|&place| place == column))
        .collect();
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); places.len()];
    for (number, line) in lines {
        if line.starts_with('#') {
            continue;
        }
        let mut count = 0;
        for (column, field) in fields(line, commas).enumerate() {
            count += 1;
            let Some(slot) = slot.get(column).copied().flatten() else {
                continue;
            };
            match field.parse::<f64>() {
                Ok(value) => columns[slot].push(value),
                Err(_) if wanted.is_none() => columns[slot].push(f64::NAN),
                Err(_) => {
                    return Err(FileError::new(
                        path,
                        format!(
                            "line {number}: `{field}` in column `{}` is not a number",
                            names[column]
                        ),
                    ));
                }
            }
        }
        // Without a header, the columns after the known ones are nobody's.
        let right = if named {
            count == names.len()
        } else {
            count >= names.len()
        };
        if !right {
            return Err(FileError::new(
                path,
                format!(
                    "line {number}: {count} fields; expected {} ({})",
                    names.len(),
                    names.join(", ")
                ),
            ));
        }
    }
    let columns = places
        .iter()
        .zip(columns)
        .map(|(&place, values)| (names[place].clone(), Column::Real(values)))
        .collect();
    Table::new(columns).map_err(|message| FileError::new(path, message))
}

/// Names in a header line, between commas or blanks, quoted or not.
fn split_names(line: &str) -> Vec<String> {
    line.split([',', ' ', '\t'])
        .map(|name| name.trim().trim_matches('"'))
        .filter(|name| !name.is_empty())
        .map(str::to_owned)
        .collect()
}

fn owned(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

/// Fields of a line, without surrounding blanks.
fn fields(line: &str, commas: bool) -> impl Iterator<Item = &str> {
    let (by_comma, by_blank) = if commas {
        (Some(line.split(',').map(str::trim)), None)
    } else {
        (None, Some(line.split_ascii_whitespace()))
    };
    by_comma
        .into_iter()
        .flatten()
        .chain(by_blank.into_iter().flatten())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str, wanted: Option<&[&str]>) -> Result<Table, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.csv");
        std::fs::write(&path, text).unwrap();
        read(&path, wanted).map_err(|e| e.to_string())
    }

    #[test]
    fn headers_and_separators_are_recognised() {
        let columns = |text| {
            let mut t = table(text, Some(&["y", "e1"])).unwrap();
            (t.take_real("y").unwrap(), t.take_real("e1").unwrap())
        };
        let expected = (vec![2.0, 6.0], vec![3.0, -7e-3]);
        assert_eq!(columns("x,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n"), expected);
        assert_eq!(columns("1 2 3 4\n 5  6 -7e-3 8\n"), expected);
        assert_eq!(
            columns("# x y e1 e2\n1 2 3 4\n# note\n\n5\t6 -7e-3 8\n"),
            expected
        );
        assert_eq!(columns("# made by hand\n1 2 3 4\n5 6 -7e-3 8\n"), expected);
        assert_eq!(columns("e1,x,y\r\n3,1,2\r\n-7e-3,5,6\r\n"), expected);
        assert_eq!(
            columns("# my method version one\n1 2 3 4\n5 6 -7e-3 8\n"),
            expected
        );
        assert_eq!(
            columns("# made by hand, by me\n# x, y, e1, e2\n1 2 3 4\n5 6 -7e-3 8\n"),
            expected
        );
        assert_eq!(
            columns("# note\nx,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n"),
            expected
        );
        assert_eq!(
            columns("\u{feff}x,y,e1,e2\n1,2,3,4\n5,6,-7e-3,8\n"),
            expected
        );
        assert_eq!(columns("1 2 3 4 0\n5 6 -7e-3 8 0\n"), expected);
        for blank in ["", "# no galaxies\n", "x,y,e1,e2\n"] {
            assert_eq!(columns(blank), (vec![], vec![]), "{blank:?}");
        }
        assert_eq!(table("x,y,e1,e2\n", None).unwrap().rows(), 0);
        assert!(table("x,y,e1,e2\n1,2,NaN,nan\n", None).is_ok());
    }

    #[test]
    fn mistakes_are_named_with_their_line() {
        let message = |text| table(text, Some(&["x", "e2"])).unwrap_err();
        assert!(message("x,y,e1,e2\n1,2,3\n").contains("line 2: 3 fields; expected 4"));
        assert!(
            message("x,y,e1,e2\n1,2,3,4\n1,2,3,four\n").contains("line 3: `four` in column `e2`")
        );
        let missing = message("x,y,g1,g2\n1,2,3,4\n");
        assert!(
            missing.contains("no column `e2`") && missing.contains("g1, g2"),
            "{missing}"
        );
    }
}
