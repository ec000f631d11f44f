//! Files of numbered sets and images are found by listing folders, not by trying all numbers: any of a million may exist.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

use shearq_files::FileError;
use shearq_files::open::is_there;

use crate::pattern::{IMAGE_PLACEHOLDERS, MAX_IMAGE, MAX_SET, SET_PLACEHOLDERS, fill};

/// Files found, by the numbers of set and image.
#[derive(Debug, Default)]
pub struct Files {
    /// `None` if the pattern has no set number, so that a file serves every set.
    by_set: BTreeMap<Option<u32>, BTreeMap<u32, Found>>,
    /// The first of the files whose numbers another file has, with the file that is read instead, and how many there are.
    unread: Option<(PathBuf, PathBuf, usize)>,
    /// The first of the files and folders whose names resemble the pattern, with the name of the first number, and how many there are.
    misnamed: Option<(PathBuf, String, usize)>,
}

#[derive(Debug)]
struct Found {
    path: PathBuf,
    rank: usize,
}

impl Files {
    /// Files by the numbers of set and image.
    pub fn from_sets(sets: BTreeMap<u32, BTreeMap<u32, PathBuf>>) -> Self {
        let found = |(image, path)| (image, Found { path, rank: 0 });
        let by_set = sets.into_iter();
        let by_set =
            by_set.map(|(set, images)| (Some(set), images.into_iter().map(found).collect()));
        Files {
            by_set: by_set.collect(),
            ..Files::default()
        }
    }

    pub fn first(&self) -> Option<&Path> {
        let mut files = self.by_set.values().flat_map(BTreeMap::values);
        files.next().map(|found| found.path.as_path())
    }

    pub fn of_set(&self, set: u32) -> Vec<(u32, PathBuf)> {
        let files = self.by_set.get(&Some(set)).or(self.by_set.get(&None));
        let files = files.into_iter().flatten();
        files
            .map(|(image, found)| (*image, found.path.clone()))
            .collect()
    }

    pub fn sets(&self) -> Vec<u32> {
        if self.serve_all_sets() {
            // Images limit the sets, not these files.
            return (0..=MAX_SET).collect();
        }
        self.by_set.keys().copied().flatten().collect()
    }

    pub fn is_empty(&self) -> bool {
        self.by_set.is_empty()
    }

    pub fn has(&self, set: u32) -> bool {
        self.serve_all_sets() || self.by_set.contains_key(&Some(set))
    }

    /// A sentence each about files that are not read, because of their names or because another one has the same numbers.
    pub fn unread(&self) -> Vec<String> {
        let misnamed = self.misnamed.as_ref().map(|(first, example, count)| {
            let why = format!("of its name (expected such as {example}). Try: rename it");
            unread(first, &why, *count)
        });
        let second = self.unread.as_ref().map(|(first, instead, count)| {
            let instead = instead.file_name().unwrap_or_default().display();
            let why = format!("{instead} is read instead. Try: remove one of them");
            unread(first, &why, *count)
        });
        misnamed.into_iter().chain(second).collect()
    }

    /// `sets`, or if empty all sets that have a file.
    pub fn wanted(&self, sets: &[u32]) -> Vec<u32> {
        match sets {
            [] => self.sets(),
            sets => sets.to_vec(),
        }
    }

    /// Whether the files belong to every set, because their pattern has no set number.
    pub fn serve_all_sets(&self) -> bool {
        self.by_set.contains_key(&None)
    }
}

fn unread(first: &Path, why: &str, count: usize) -> String {
    let thing = if first.is_dir() { "folder" } else { "file" };
    let others = match count - 1 {
        0 => String::new(),
        1 => ", like 1 other".to_owned(),
        more => format!(", like {more} others"),
    };
    format!(
        "{}: this {thing} is not read{others}, because {why}",
        first.display()
    )
}

// A name without what people write differently: case, separators and numbers.
fn shape(name: &str) -> String {
    let mut shape: Vec<char> = (name.to_lowercase().chars())
        .filter(|c| !['-', '_', ' '].contains(c))
        .map(|c| if c.is_ascii_digit() { '#' } else { c })
        .collect();
    shape.dedup_by(|a, b| (*a, *b) == ('#', '#'));
    shape.into_iter().collect()
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Numbers {
    set: Option<u32>,
    image: Option<u32>,
}

struct Search<'a> {
    /// Endings that a file's name may have beyond the pattern's.
    endings: &'a [&'a str],
    /// Sets to look for; all if empty.
    sets: &'a [u32],
    files: Files,
}

/// Finds the files below `root` that match `pattern`, of `sets` (of all if empty), with one of `endings` after the name.
/// If there are several endings, the first counts.
///
/// Anything with such a name counts as a file, so that unreadable files are reported later. Files of a pattern without an
/// image number have number 0.
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
        // Without a number the name is known, and the folder need not be listed: it may have a million files.
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
        let example = fill(&part.to_string_lossy(), 1, 1);
        let usual = shape(&example);
        for name in names(folder)? {
            let mut follows = false;
            for (rank, ending) in endings.iter().enumerate() {
                let Some(stem) = name.strip_suffix(ending) else {
                    continue;
                };
                for numbers in matches(&pattern, stem, numbers) {
                    follows = true;
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
            // With `sets`, the others are left out on purpose, and an absent one is an error.
            let resembles = !follows && self.sets.is_empty() && shape(&name) == usual;
            let path = folder.join(&name);
            if resembles && path.is_dir() != rest.is_empty() {
                let first = || (path, example.clone(), 0);
                self.files.misnamed.get_or_insert_with(first).2 += 1;
            }
        }
        Ok(())
    }

    fn add(&mut self, path: PathBuf, numbers: Numbers, rank: usize) {
        let image = numbers.image.unwrap_or(0);
        let of_set = self.files.by_set.entry(numbers.set).or_default();
        let found = Found { path, rank };
        let (path, better) = match of_set.remove(&image) {
            None => {
                of_set.insert(image, found);
                return;
            }
            Some(other) if found.rank < other.rank => (other.path, found),
            Some(other) => (found.path, other),
        };
        let first = || (path, better.path.clone(), 0);
        self.files.unread.get_or_insert_with(first).2 += 1;
        of_set.insert(image, better);
    }
}

// Of names in a message. Chosen by hand.
const MAX_LISTED: usize = 4;

/// The first names in a folder as a message lists them.
pub fn sample(folder: &Path) -> Result<String, FileError> {
    let names = names(folder)?;
    let list = names.iter().take(MAX_LISTED).map(String::as_str);
    let list = list.collect::<Vec<_>>().join(", ");
    Ok(match names.len().checked_sub(MAX_LISTED) {
        None if names.is_empty() => "an empty folder".into(),
        None | Some(0) => list,
        Some(more) => format!("{list} and {more} more"),
    })
}

// Sorted, because file systems list in any order and results must not depend on it. Names that are not UTF-8 follow no pattern.
fn names(folder: &Path) -> Result<Vec<String>, FileError> {
    let place = match folder.as_os_str().is_empty() {
        true => Path::new("."),
        false => folder,
    };
    let entries = match fs::read_dir(place) {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            // A broken link is likely a disk that is not mounted, and must not look like an empty folder.
            return match place.ancestors().find(|place| is_there(place)) {
                Some(link) if !link.exists() => {
                    let message = "this is a broken link; expected a folder";
                    Err(FileError::new(link, message))
                }
                _ => Ok(Vec::new()),
            };
        }
        entries => entries,
    };
    let name = |entry: std::io::Result<fs::DirEntry>| Ok(entry?.file_name().into_string().ok());
    let mut names: Vec<String> = entries
        .and_then(|entries| entries.map(name).filter_map(Result::transpose).collect())
        .map_err(FileError::doing(place, "cannot read the folder"))?;
    names.sort_unstable();
    Ok(names)
}

#[derive(Debug, Clone, Copy)]
enum Piece<'a> {
    Text(&'a str),
    Number {
        of_set: bool,
        /// Zeros fill numbers to this length.
        digits: usize,
    },
}

fn most(of_set: bool) -> u32 {
    if of_set { MAX_SET } else { MAX_IMAGE }
}

fn pieces(pattern: &OsStr) -> Vec<Piece<'_>> {
    let Some(mut rest) = pattern.to_str() else {
        return Vec::new();
    };
    let mut found = Vec::new();
    while !rest.is_empty() {
        let next = [SET_PLACEHOLDERS, IMAGE_PLACEHOLDERS]
            .into_iter()
            .zip([true, false])
            .flat_map(|(forms, of_set)| forms.into_iter().zip(1..).map(move |form| (form, of_set)))
            .filter_map(|((form, digits), of_set)| Some((rest.find(form)?, form, of_set, digits)))
            .min_by_key(|(at, ..)| *at);
        let Some((at, name, of_set, digits)) = next else {
            found.push(Piece::Text(rest));
            break;
        };
        if at > 0 {
            found.push(Piece::Text(&rest[..at]));
        }
        found.push(Piece::Number { of_set, digits });
        rest = &rest[at + name.len()..];
    }
    found
}

// Several ways are possible where two numbers touch, as in `{set}{image}`; the numbers of earlier folders exclude most.
fn matches(pattern: &[Piece<'_>], name: &str, known: Numbers) -> Vec<Numbers> {
    let Some((piece, rest)) = pattern.split_first() else {
        return if name.is_empty() {
            vec![known]
        } else {
            Vec::new()
        };
    };
    let (of_set, zeros) = match *piece {
        Piece::Text(text) => {
            let end = name.strip_prefix(text);
            return end.map_or_else(Vec::new, |end| matches(rest, end, known));
        }
        Piece::Number { of_set, digits } => (of_set, digits),
    };
    let most = most(of_set);
    let before = if of_set { known.set } else { known.image };
    let width = most.to_string().len();
    let digits = name.bytes().take_while(u8::is_ascii_digit).take(width);
    (1..=digits.count())
        .filter(|length| *length == zeros || *length > zeros && !name.starts_with('0'))
        .filter_map(|length| Some((name[..length].parse().ok()?, &name[length..])))
        .filter(|(number, _)| *number <= most)
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
    fn names_that_resemble_the_pattern_are_reported() {
        let root = tempfile::tempdir().unwrap();
        for name in [
            "set01/g-001.fits",
            "set01/g_002.FITS",
            "set01/stars-001.fits",
            "set2/g-001.fits",
            "Set 3/g-001.fits",
            "settings/g-001.fits",
        ] {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let unread = |sets: &[u32]| {
            let pattern = "set{set:02}/g-{image:03}.fits";
            find(root.path(), pattern, &[""], sets).unwrap().unread()
        };
        let [line] = <[String; 1]>::try_from(unread(&[])).unwrap();
        let words = "Set 3: this folder is not read, like 2 others, because of its name (expected such as set01)";
        assert!(line.contains(words), "{line}");
        assert!(unread(&[1]).is_empty());
    }

    #[test]
    fn names_match_filled_patterns() {
        let both = |set, image| vec![(Some(set), Some(image))];
        let (set, image) = (
            |set| vec![(Some(set), None)],
            |image| vec![(None, Some(image))],
        );
        for (pattern, name, expected) in [
            ("set{set:02}", "set07", set(7)),
            ("set{set:02}", "set100", set(100)),
            ("g-{image:03}.fits", "g-012.fits", image(12)),
            ("g-{image:03}.fits", "g-123456.fits", image(123_456)),
            ("{set}_{image}.NN.dat", "7_12.NN.dat", both(7, 12)),
            ("{set}{image}", "112", [both(1, 12), both(11, 2)].concat()),
            ("{set}-{image}-{set}", "3-4-3", both(3, 4)),
            (
                "image-{set:03}-{image}.fits",
                "image-000-0.fits",
                both(0, 0),
            ),
            ("set{set:02}", "set7", vec![]),
            ("set{set:02}", "set007", vec![]),
            ("set{set}", "set07", vec![]),
            ("set{set}", "set10000", vec![]),
            ("g-{image}.fits", "g-1000000.fits", vec![]),
            ("g-{image:03}.fits", "g-0001.fits", vec![]),
            ("g-{image}.fits", "g-+1.fits", vec![]),
            ("g-{image}.fits", "g-1.fits.gz", vec![]),
            ("{set}-{image}-{set}", "3-4-5", vec![]),
        ] {
            assert_eq!(numbers(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn files_are_found_wherever_the_numbers_are() {
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
        let nine = find("a/set{set:02}/i-{image:03}", &[9]).unwrap();
        assert_eq!(nine.sets(), [9]);
        let deep = find("a/../a/set0{image}/i-001", &[]).unwrap();
        assert_eq!(named(&deep, 5), ["9 a/../a/set09/i-001"]);
        assert!(deep.serve_all_sets() && deep.has(7));
        assert!(find("b/{set}/{image}", &[]).unwrap().sets().is_empty());
        fs::create_dir(root.path().join("a/set09/i-002")).unwrap();
        let all = find("a/set{set:02}/i-{image:03}", &[]).unwrap();
        assert_eq!(all.of_set(9).len(), 2);
        fs::write(root.path().join("a/set08"), "").unwrap();
        let wrong = find("a/set{set:02}/i-{image:03}", &[])
            .unwrap_err()
            .to_string();
        assert!(wrong.contains("a/set08: cannot read the folder"), "{wrong}");
        assert!(find("a/set{set:02}/i-{image:03}", &[7]).is_ok());
    }
}
