//! Tables of numbers that participants and organisers wrote, with or without names of columns.

use std::fmt::Display;
use std::path::Path;

use shearq_files::FileError;
use shearq_files::table::{self, MAX_ROWS, Named, Place};

// A table that a participant or an organiser wrote. Each wanted column has several names; the last ones may be absent, and are
// then empty.
pub(crate) struct Columns<'a> {
    pub(crate) names: &'a [&'a [&'a str]],
    pub(crate) required: usize,
    // Places of the columns in a text table without names, by its number of columns.
    pub(crate) unnamed: &'a [(usize, &'a [usize])],
}

// Programs write ID, id and Id.
fn is_named(name: &str, aliases: &[&str]) -> bool {
    aliases.iter().any(|own| name.eq_ignore_ascii_case(own))
}

impl Columns<'_> {
    pub(crate) fn read(&self, path: &Path) -> Result<Vec<Vec<f64>>, FileError> {
        Ok(self.read_all(path)?.0)
    }

    // The wanted columns, and the names of the others.
    pub(crate) fn read_all(&self, path: &Path) -> Result<(Vec<Vec<f64>>, Vec<String>), FileError> {
        let mut place = Place::of(path);
        let found = table::columns(&place)?;
        // A FITS file may have several tables: the first with all columns is meant. Of a text, words of a comment name columns only
        // if they are as many, which the comments of the challenge's own files are not.
        let picked = found.named.iter().find_map(|named| {
            let places = self.places_in(&named.names)?;
            Some((named, places))
        });
        let is_number = |word: &String| word.parse::<f64>().is_ok();
        let header = |named: &&Named| !named.names.iter().all(is_number);
        let (names, chosen) = match (picked, found.named.iter().find(header)) {
            (Some((named, places)), _) => {
                place.table = named.table.as_ref().map(|head| head.number.to_string());
                let name = |place: usize| match named.doubtful {
                    true => (place + 1).to_string(),
                    false => named.names[place].clone(),
                };
                let chosen = places.into_iter().map(|place| place.map(name));
                (&*named.names, chosen.collect::<Vec<_>>())
            }
            // By its places, `# ID e2 e1 weight` would exchange the components.
            (
                None,
                Some(Named {
                    names, doubtful, ..
                }),
            ) => {
                let of = if *doubtful { "comment" } else { "columns" };
                let message = format!(
                    "found the {of} {}, expected {}",
                    names.join(", "),
                    self.described()
                );
                let mut error = FileError::new(path, message);
                error.no_column = !doubtful;
                error.hint = doubtful
                    .then(|| "these names, or no comment of as many words as columns".to_owned());
                return Err(error);
            }
            (None, None) => (&[][..], self.unnamed(path, &found)?),
        };
        let wanted: Vec<&str> = chosen.iter().flatten().map(String::as_str).collect();
        let read = table::read_from(&place, Some(&wanted), MAX_ROWS)?;
        let column = |name: &Option<String>| match name {
            None => Ok(Vec::new()),
            Some(name) => Ok(table::numbers(&read, name, path)?.into_owned()),
        };
        let columns = chosen
            .iter()
            .map(column)
            .collect::<Result<_, FileError>>()?;
        let is_wanted = |name: &&String| self.names.iter().any(|own| is_named(name, own));
        let others = names.iter().filter(|name| !is_wanted(name)).cloned();
        Ok((columns, others.collect()))
    }

    // The place of each wanted column among `names`; `None` if one is missing.
    fn places_in(&self, names: &[String]) -> Option<Vec<Option<usize>>> {
        let picked = self.names.iter().zip(0..).map(|(aliases, k)| {
            match names.iter().position(|name| is_named(name, aliases)) {
                None if k < self.required => None,
                place => Some(place),
            }
        });
        picked.collect()
    }

    // The numbers of the wanted columns in a table without names.
    fn unnamed(
        &self,
        path: &Path,
        found: &table::Columns,
    ) -> Result<Vec<Option<String>>, FileError> {
        let count = found.unnamed.len();
        let Some((_, places)) = self.unnamed.iter().find(|(n, _)| *n == count) else {
            let message = format!("found {count} columns, expected {}", self.described());
            return wrong(path, message);
        };
        // `# columns: ID g2 g1 w` and `# ID | g2 | g1 | w` state an order, too, but not which word is which column. One that begins
        // with the order of the columns, such as `# index g1 g2 (true shear)`, agrees with it.
        let agrees = |words: &[String]| {
            let mut pairs = self.names.iter().zip(*places);
            pairs.all(|(aliases, place)| is_named(&words[*place], aliases))
        };
        let states_names = |words: &&Vec<String>| {
            self.places_in(words).is_some() && !(words.len() > count && agrees(words))
        };
        if let Some(words) = found.remarks.iter().find(states_names) {
            let message = format!(
                "found {count} columns below the comment {}, expected one word per column",
                words.join(" ")
            );
            return Err(
                FileError::new(path, message).hint("these names alone, or no comment of them")
            );
        }
        let number = |k: usize| places.get(k).map(|place| (place + 1).to_string());
        Ok((0..self.names.len()).map(number).collect())
    }

    fn described(&self) -> String {
        let names = self.names.iter().zip(0..);
        let names = names.map(|(names, k)| match k < self.required {
            true => names[0].to_owned(),
            false => format!("[{}]", names[0]),
        });
        names.collect::<Vec<_>>().join(" ")
    }
}

// Identities are read as numbers; a fraction or a sign means another column, which `as usize` would hide.
pub(crate) fn whole(value: f64, end: usize) -> Option<usize> {
    let is_whole = value >= 0.0 && value < end as f64 && value.fract() == 0.0;
    is_whole.then_some(value as usize)
}

pub(crate) fn wrong<T>(path: &Path, fault: impl Display) -> Result<T, FileError> {
    Err(FileError::new(path, fault))
}
