//! Images of a folder, and the share of one process.

use std::collections::BTreeSet;
use std::path::Path;
use std::str::FromStr;

use shearq_files::FileError;

pub use crate::files::{Files, find, sample};
use crate::great3;
use crate::layout::{DataFolder, fill};
use crate::pattern::STAMPS;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageId {
    pub set: u32,
    pub image: u32,
}

/// Images of `sets` of a data folder (of all its sets if empty), in order.
pub fn of_folder(data: &DataFolder, sets: &[u32]) -> Result<Vec<ImageId>, FileError> {
    let files = data.images(sets)?;
    let mut found = Vec::new();
    for set in files.wanted(sets) {
        let images = files.of_set(set);
        if images.is_empty() {
            let path = data.galaxies(set, 1);
            let message = format!("there is no image of set {set}; expected this file");
            return Err(no_images(data, &path, message));
        }
        let id = |(image, _)| ImageId { set, image };
        found.extend(images.into_iter().map(id));
    }
    if found.is_empty() {
        let pattern = &data.layout().galaxies;
        let (example, found) = (fill(pattern, 1, 1), sample(data.root())?);
        let message = format!(
            "there are no galaxy images here (found {found}, expected {pattern}, as in {example})"
        );
        return Err(no_images(data, data.root(), message));
    }
    Ok(found)
}

/// Checks that no epoch of `sets` (all if empty) is missing: a galaxy without one of them would have more noise than its neighbours
/// for no reason that anybody could see.
pub(crate) fn check_epochs(data: &DataFolder, sets: &[u32]) -> Result<(), FileError> {
    match data.layout().great3 {
        Some(_) => check_subfields(data, sets),
        None => check_exposures(data, sets),
    }
}

// All subfields of a branch have the same epochs, from 0. Not only images show which: the last epoch may be lost from all subfields,
// or all epochs of a subfield.
fn check_subfields(data: &DataFolder, sets: &[u32]) -> Result<(), FileError> {
    let images = data.images(&[])?;
    let others = great3::files_of_epochs(data.root())?;
    let all: Vec<&Files> = std::iter::once(&images).chain(&others).collect();
    let subfields: BTreeSet<u32> = all.iter().flat_map(|files| files.sets()).collect();
    let last = subfields
        .iter()
        .flat_map(|&set| all.iter().flat_map(move |files| files.of_set(set)));
    let Some((last, witness)) = last.max_by_key(|(epoch, _)| *epoch) else {
        return Ok(());
    };
    let wanted = match sets {
        [] => subfields.into_iter().collect(),
        sets => sets.to_vec(),
    };
    for set in wanted {
        let there: Vec<u32> = images.of_set(set).into_iter().map(|(at, _)| at).collect();
        if let Some(epoch) = (0..=last).find(|epoch| !there.contains(epoch)) {
            let witness = witness.file_name().unwrap_or_default().display();
            let expected = match last {
                0 => "expected epoch 0, as all subfields of the branch have".to_owned(),
                last => format!("expected epochs 0 to {last}, as there is {witness}"),
            };
            let message = format!(
                "there is no such epoch (found {} of subfield {set}, {expected})",
                listed(&there)
            );
            return Err(FileError::new(data.galaxies(set, epoch), message).hint(
                match there.is_empty() {
                    true => "restore the image, or --sets with the subfields that have images",
                    false => "restore the image",
                },
            ));
        }
    }
    Ok(())
}

// Sets of gathered exposures may have different numbers of them, but each has consecutive ones with a table of stamps.
fn check_exposures(data: &DataFolder, sets: &[u32]) -> Result<(), FileError> {
    let images = data.images(sets)?;
    let tables = find(data.root(), STAMPS, &[""], sets)?;
    for set in images.wanted(sets) {
        let there: BTreeSet<u32> = images.of_set(set).into_iter().map(|(at, _)| at).collect();
        let stated = tables.of_set(set).into_iter().map(|(at, _)| at);
        let stated: BTreeSet<u32> = stated.chain(there.iter().copied()).collect();
        let (Some(&first), Some(&last)) = (stated.first(), stated.last()) else {
            continue;
        };
        if let Some(image) = (first..=last).find(|image| !there.contains(image)) {
            let there: Vec<u32> = there.into_iter().collect();
            let message = format!(
                "there is no such image (found {} of set {set}, expected {first} to {last}, all epochs of the set)",
                listed(&there)
            );
            return Err(FileError::new(data.galaxies(set, image), message).hint("gather it again or, if it was left out on purpose, remove its table of stamps and give later images of the set, their stamps and PSFs lower numbers"));
        }
    }
    Ok(())
}

fn listed(numbers: &[u32]) -> String {
    match numbers {
        [] => "none".to_owned(),
        numbers => {
            let each: Vec<String> = numbers.iter().map(u32::to_string).collect();
            each.join(", ")
        }
    }
}

fn no_images(data: &DataFolder, path: &Path, message: String) -> FileError {
    match data.folder_above() {
        Some(folder) => FileError::new(path, message + ". This is the folder of one set")
            .hint(format!("--data {}", folder.display())),
        None => FileError::new(path, message),
    }
}

/// Images 1 to `images` of each of `sets`, in order.
pub fn of_simulation(sets: &[u32], images: u32) -> Vec<ImageId> {
    sets.iter()
        .flat_map(|&set| (1..=images).map(move |image| ImageId { set, image }))
        .collect()
}

/// One of several shards of the work on many images. Images are dealt out in turn, so each is in exactly one shard and
/// the numbers of images differ by at most one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    number: u32,
    of: u32,
}

impl Shard {
    pub const WHOLE: Shard = Shard { number: 1, of: 1 };

    // In turn, not in blocks, so that shards have equally many images of each set, too: sets take different times.
    pub fn part(&self, all: &[ImageId]) -> Vec<ImageId> {
        all.iter()
            .enumerate()
            .filter(|(position, _)| Shard::holding(*position, self.of) == *self)
            .map(|(_, &image)| image)
            .collect()
    }

    /// The shard, of `of`, of the image at `position` in the list of all, from 0.
    pub fn holding(position: usize, of: u32) -> Shard {
        Shard {
            number: (position % of as usize) as u32 + 1,
            of,
        }
    }

    pub fn of(&self) -> u32 {
        self.of
    }

    pub fn number(&self) -> u32 {
        self.number
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.split_once('/')
            .and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)))
            .filter(|&(number, of)| (1..=of).contains(&number))
            .map(|(number, of)| Shard { number, of })
            .ok_or_else(|| "expected K/N, shard K of N, with K from 1 to N".into())
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_image_is_in_exactly_one_of_equal_shards() {
        let all = of_simulation(&[1, 7, 24], 5);
        for of in [1, 2, 4, 15, 40] {
            let parts: Vec<Vec<ImageId>> = (1..=of)
                .map(|number| Shard { number, of }.part(&all))
                .collect();
            let mut together: Vec<ImageId> = parts.concat();
            together.sort_by_key(|id| (id.set, id.image));
            assert_eq!(together, all);
            let sizes = parts.iter().map(Vec::len);
            assert!(sizes.clone().max().unwrap() - sizes.min().unwrap() <= 1);
        }
    }

    #[test]
    fn shards_are_named_by_number_and_count() {
        assert_eq!("1/1".parse(), Ok(Shard::WHOLE));
        assert_eq!("3/20".parse::<Shard>().unwrap().to_string(), "3/20");
        for wrong in ["0/3", "4/3", "3", "1/0", "-1/2", "1/2/3", "a/b", ""] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
