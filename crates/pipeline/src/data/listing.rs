//! Which files of numbered sets and images there are: folders are listed, names are not guessed.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

use crate::data::layout::{IMAGE_PLACEHOLDERS, MAX_IMAGE, MAX_SET, SET_PLACEHOLDERS};
use shearq_files::FileError;
use shearq_files::open::is_there;

/// Files found, by the numbers of set and image.
#[derive(Debug, Default)]
pub struct Files {
    /// No number of a set where the pattern has none, so that a file serves every set.
    by_set: BTreeMap<Option<u32>, BTreeMap<u32, Found>>,
}

#[derive(Debug)]
struct Found {
    path: PathBuf,
    /// Place of its ending among those looked for.
    rank: usize,
}

impl Files {
    /// Those of a set, by image number.
    pub fn of_set(&self, set: u32) -> Vec<(u32, PathBuf)> {
        let files = self.by_set.get(&Some(set)).or(self.by_set.get(&None));
        let files = files.into_iter().flatten();
        files
            .map(|(image, found)| (*image, found.path.clone()))
            .collect()
    }

    /// Sets that have a file, in order.
    pub fn sets(&self) -> Vec<u32> {
        if self.serve_all_sets() {
            return (1..=MAX_SET).collect();
        }
        self.by_set.keys().copied().flatten().collect()
    }

    /// Those of `sets`, or the sets that have a file where there are none of them.
    pub fn wanted(&self, sets: &[u32]) -> Vec<u32> {
        match sets {
            [] => self.sets(),
            sets => sets.to_vec(),
        }
    }

    /// Whether the files belong to every set, as their pattern has no number of one.
    pub fn serve_all_sets(&self) -> bool {
        self.by_set.contains_key(&None)
    }
}

/// Numbers that a name holds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Numbers {
    set: Option<u32>,
    image: Option<u32>,
}

/// What to look for.
struct Search<'a> {
    /// Endings that a file's name may have beyond the pattern's.
    endings: &'a [&'a str],
    /// Sets to look for; all if empty.
    sets: &'a [u32],
    files: Files,
}

/// Finds the files below `root` that `pattern` names, of `sets` (of all if empty), with any of
/// `endings` after the name; the first of them where there are several.
///
/// Whatever is called so is taken for a file, so that none is left out that cannot be read.
///
/// # Errors
/// Where a folder cannot be listed.
pub fn find(
    root: &Path,
    pattern: &str,
    endings: &[&str],
    sets: &[u32],
) -> Result<Files, FileError> {
    let mut search = Search {
        endings,
        sets,
        files: Files::default(),
    };
    let parts: Vec<Component<'_>> = Path::new(pattern).components().collect();
    search.walk(root, &parts, Numbers::default())?;
    Ok(search.files)
}

impl Search<'_> {
    /// Follows the rest of a pattern from `folder` on.
    fn walk(
        &mut self,
        folder: &Path,
        parts: &[Component<'_>],
        numbers: Numbers,
    ) -> Result<(), FileError> {
        let Some((part, rest)) = parts.split_first() else {
            return Ok(());
        };
        let part = part.as_os_str();
        let pattern = pieces(part);
        let endings = if rest.is_empty() { self.endings } else { &[""] };
        if let [Piece::Text(_)] | [] = pattern.as_slice() {
            if !rest.is_empty() {
                return self.walk(&folder.join(part), rest, numbers);
            }
            for (rank, ending) in endings.iter().enumerate() {
                let mut name = part.to_owned();
                name.push(ending);
                let path = folder.join(name);
                if is_there(&path) {
                    self.add(path, numbers, rank);
                }
            }
            return Ok(());
        }
        for name in names(folder)? {
            for (rank, ending) in endings.iter().enumerate() {
                let Some(stem) = name.strip_suffix(ending) else {
                    continue;
                };
                for numbers in matches(&pattern, stem, numbers) {
                    let other = |set| !self.sets.is_empty() && !self.sets.contains(&set);
                    if numbers.set.is_some_and(other) {
                        continue;
                    }
                    let path = folder.join(&name);
                    if rest.is_empty() {
                        self.add(path, numbers, rank);
                    } else {
                        self.walk(&path, rest, numbers)?;
                    }
                }
            }
        }
        Ok(())
    }

    fn add(&mut self, path: PathBuf, numbers: Numbers, rank: usize) {
        let Some(image) = numbers.image else {
            return;
        };
        let of_set = self.files.by_set.entry(numbers.set).or_default();
        if of_set.get(&image).is_none_or(|other| rank < other.rank) {
            of_set.insert(image, Found { path, rank });
        }
    }
}

/// Names in a folder that are UTF-8, none if it does not exist.
fn names(folder: &Path) -> Result<Vec<String>, FileError> {
    let place = match folder.as_os_str().is_empty() {
        true => Path::new("."),
        false => folder,
    };
    let entries = match fs::read_dir(place) {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            // A link that leads nowhere is there.
            return match place.ancestors().find(|place| is_there(place)) {
                Some(link) if !link.exists() => {
                    let message = "this leads nowhere; expected a folder";
                    Err(FileError::new(link, message))
                }
                _ => Ok(Vec::new()),
            };
        }
        entries => entries,
    };
    let name = |entry: std::io::Result<fs::DirEntry>| Ok(entry?.file_name().into_string().ok());
    entries
        .and_then(|entries| entries.map(name).filter_map(Result::transpose).collect())
        .map_err(FileError::doing(place, "cannot read the folder"))
}

/// A part of the pattern of a name.
#[derive(Debug, Clone, Copy)]
enum Piece<'a> {
    Text(&'a str),
    Number { of_set: bool, padded: bool },
}

/// Parts of a pattern of one name. What is not UTF-8 has no numbers.
fn pieces(pattern: &OsStr) -> Vec<Piece<'_>> {
    let Some(mut rest) = pattern.to_str() else {
        return Vec::new();
    };
    let mut found = Vec::new();
    while !rest.is_empty() {
        let next = [SET_PLACEHOLDERS, IMAGE_PLACEHOLDERS]
            .into_iter()
            .zip([true, false])
            .flat_map(|([plain, padded], of_set)| [(plain, of_set, false), (padded, of_set, true)])
            .filter_map(|(name, of_set, padded)| Some((rest.find(name)?, name, of_set, padded)))
            .min_by_key(|(at, ..)| *at);
        let Some((at, name, of_set, padded)) = next else {
            found.push(Piece::Text(rest));
            break;
        };
        if at > 0 {
            found.push(Piece::Text(&rest[..at]));
        }
        found.push(Piece::Number { of_set, padded });
        rest = &rest[at + name.len()..];
    }
    found
}

/// All ways in which a name can follow a pattern, given the numbers known already.
fn matches(pattern: &[Piece<'_>], name: &str, known: Numbers) -> Vec<Numbers> {
    let Some((piece, rest)) = pattern.split_first() else {
        return if name.is_empty() {
            vec![known]
        } else {
            Vec::new()
        };
    };
    let (of_set, padded) = match *piece {
        Piece::Text(text) => {
            let end = name.strip_prefix(text);
            return end.map_or_else(Vec::new, |end| matches(rest, end, known));
        }
        Piece::Number { of_set, padded } => (of_set, padded),
    };
    let (most, before) = match of_set {
        true => (MAX_SET, known.set),
        false => (MAX_IMAGE, known.image),
    };
    let width = most.to_string().len();
    let digits = name.bytes().take_while(u8::is_ascii_digit).take(width);
    (1..=digits.count())
        .filter(|length| !padded || *length == width)
        .filter(|length| padded || !name.starts_with('0') || *length == 0)
        .filter_map(|length| Some((name[..length].parse().ok()?, &name[length..])))
        .filter(|(number, _)| (1..=most).contains(number))
        .filter(|(number, _)| before.is_none_or(|before| before == *number))
        .flat_map(|(number, end)| {
            let numbers = match of_set {
                true => Numbers {
                    set: Some(number),
                    ..known
                },
                false => Numbers {
                    image: Some(number),
                    ..known
                },
            };
            matches(rest, end, numbers)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(pattern: &str, name: &str) -> Vec<(Option<u32>, Option<u32>)> {
        let pattern = pieces(OsStr::new(pattern));
        let found = matches(&pattern, name, Numbers::default());
        found.iter().map(|n| (n.set, n.image)).collect()
    }

    #[test]
    fn names_follow_patterns_as_they_are_filled() {
        let both = |set, image| vec![(Some(set), Some(image))];
        assert_eq!(numbers("set{set:02}", "set07"), [(Some(7), None)]);
        assert_eq!(
            numbers("g-{image:03}.fits", "g-012.fits"),
            [(None, Some(12))]
        );
        assert_eq!(numbers("{set}_{image}.NN.dat", "7_12.NN.dat"), both(7, 12));
        assert_eq!(
            numbers("{set}{image}", "112"),
            [both(1, 12), both(11, 2)].concat()
        );
        assert_eq!(numbers("{set}-{image}-{set}", "3-4-3"), both(3, 4));
        for (pattern, name) in [
            ("set{set:02}", "set7"),
            ("set{set:02}", "set007"),
            ("set{set}", "set07"),
            ("set{set}", "set0"),
            ("set{set}", "set100"),
            ("g-{image}.fits", "g-1000.fits"),
            ("g-{image}.fits", "g-+1.fits"),
            ("g-{image}.fits", "g-1.fits.gz"),
            ("{set}-{image}-{set}", "3-4-5"),
        ] {
            assert_eq!(numbers(pattern, name), [], "{pattern} {name}");
        }
    }

    #[test]
    fn files_are_found_wherever_the_numbers_stand() {
        let root = tempfile::tempdir().unwrap();
        for name in [
            "a/set07/i-012",
            "a/set07/i-013.gz",
            "a/set07/i-012.gz",
            "a/set09/i-001",
        ] {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let find = |pattern: &str, sets: &[u32]| find(root.path(), pattern, &["", ".gz"], sets);
        let named = |files: &Files, set| -> Vec<String> {
            let name = |(image, path): (u32, PathBuf)| {
                format!("{image} {}", path.strip_prefix(&root).unwrap().display())
            };
            files.of_set(set).into_iter().map(name).collect()
        };
        let all = find("a/set{set:02}/i-{image:03}", &[]).unwrap();
        assert_eq!(all.sets(), [7, 9]);
        assert_eq!(named(&all, 7), ["12 a/set07/i-012", "13 a/set07/i-013.gz"]);
        assert_eq!(
            find("a/set{set:02}/i-{image:03}", &[9]).unwrap().sets(),
            [9]
        );
        let deep = find("a/../a/set0{image}/i-001", &[]).unwrap();
        assert_eq!(named(&deep, 5), ["9 a/../a/set09/i-001"]);
        assert_eq!(deep.sets().len(), 99);
        assert!(find("b/{set}/{image}", &[]).unwrap().sets().is_empty());
        fs::create_dir(root.path().join("a/set09/i-002")).unwrap();
        let all = find("a/set{set:02}/i-{image:03}", &[]).unwrap();
        assert_eq!(all.of_set(9).len(), 2);
        fs::write(root.path().join("a/set08"), "").unwrap();
        let wrong = find("a/set{set:02}/i-{image:03}", &[]).unwrap_err();
        assert!(
            wrong
                .to_string()
                .contains("a/set08: cannot read the folder"),
            "{wrong}"
        );
        assert!(find("a/set{set:02}/i-{image:03}", &[7]).is_ok());
    }
}
