//! CSV and ASCII tables of numbers.

use std::path::Path;

use super::error::FileError;
use super::table::{Column, Table};

/// Columns of an ASCII table without a header: the challenge's catalogue.
const CHALLENGE_COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// Reads the columns `wanted` (all that are numbers, if `None`).
///
/// The first line that is not empty names the columns if it starts with `#` or its first field is
/// not a number. Fields are separated by commas if the first line has one, by blanks otherwise.
/// Later lines starting with `#` are comments.
pub(super) fn read(path: &Path, wanted: Option<&[&str]>) -> Result<Table, FileError> {
    read_named(path, wanted, &CHALLENGE_COLUMNS)
}

/// The same, with other names for the columns of a table without a header.
pub(super) fn read_named(
    path: &Path,
    wanted: Option<&[&str]>,
    default_names: &[&str],
) -> Result<Table, FileError> {
    let text = std::fs::read(path).map_err(FileError::doing(path, "cannot read the table"))?;
    let text = std::str::from_utf8(&text).map_err(|e| {
        FileError::new(
            path,
            format!(
                "this is not a text table: byte {} is not UTF-8",
                e.valid_up_to() + 1
            ),
        )
    })?;
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(k, line)| (k + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty())
        .peekable();
    let Some(&(_, first)) = lines.peek() else {
        return Err(FileError::new(
            path,
            "the file is empty; expected a table with a header or numbers",
        ));
    };
    let commas = first.contains(',');
    let is_header = first.starts_with('#')
        || fields(first, commas)
            .next()
            .is_some_and(|field| field.parse::<f64>().is_err());
    let mut names: Vec<String> = if is_header {
        let line = first.trim_start_matches('#').trim();
        let names = fields(line, commas)
            .map(|name| name.trim_matches('"').to_owned())
            .collect();
        lines.next();
        names
    } else {
        owned(default_names)
    };
    // A `#` line of prose is no header: the challenge's columns are meant then.
    if first.starts_with('#')
        && let Some((_, line)) = lines.peek()
        && fields(line, commas).count() != names.len()
    {
        names = owned(default_names);
    }
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
        if count != names.len() {
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
        assert_eq!(table("x,y,e1,e2\n", None).unwrap().rows(), 0);
        assert!(table("x,y,e1,e2\n1,2,NaN,nan\n", None).is_ok());
    }

    #[test]
    fn mistakes_are_named_with_their_line() {
        let message = |text| table(text, Some(&["x", "e2"])).unwrap_err();
        assert!(message("").contains("empty"));
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
