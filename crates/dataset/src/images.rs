//! Images of a folder, and the share of one process.

use std::str::FromStr;

use crate::layout::{DataFolder, fill};
use crate::listing::{self, Files};
use shearq_files::FileError;

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
            let advice = advice(data, &files);
            let message = format!("there is no image of set {set}; expected this file{advice}");
            return Err(FileError::new(path, message));
        }
        let id = |(image, _)| ImageId { set, image };
        found.extend(images.into_iter().map(id));
    }
    if found.is_empty() {
        let pattern = &data.layout().galaxies;
        let (example, found) = (fill(pattern, 1, 1), listing::sample(data.root())?);
        let advice = advice(data, &files);
        let message = format!(
            "there are no galaxy images here (found {found}, expected {pattern}, as in {example}){advice}"
        );
        return Err(FileError::new(data.root(), message));
    }
    Ok(found)
}

/// Checks that each of `sets` (all if empty) has the epochs 0 to N of GREAT3, as the subfield with most epochs has: a galaxy without
/// one of them would have more noise than its neighbours for no reason that anybody could see.
pub(crate) fn check_epochs(data: &DataFolder, sets: &[u32]) -> Result<(), FileError> {
    let files = data.images(&[])?;
    let of_set = |set: u32| files.of_set(set).into_iter().map(|(epoch, _)| epoch);
    let last = files
        .sets()
        .into_iter()
        .filter_map(|set| Some((of_set(set).max()?, set)));
    let Some((last, full)) = last.max_by_key(|(last, _)| *last) else {
        return Ok(());
    };
    for set in files.wanted(sets) {
        let there: Vec<u32> = of_set(set).collect();
        if let Some(epoch) = (0..=last).find(|epoch| !there.contains(epoch)) {
            let message = format!(
                "there is no such epoch (found {} of subfield {set}, expected {}, as subfield {full} has {last} for the last){}",
                there.len(),
                last + 1,
                advice(data, &files)
            );
            return Err(FileError::new(data.galaxies(set, epoch), message));
        }
    }
    Ok(())
}

fn advice(data: &DataFolder, files: &Files) -> String {
    // Misspelt names explain missing images better than a wrong folder does.
    if let Some(line) = files.unread().first() {
        return format!(". {line}");
    }
    match data.folder_above() {
        Some(folder) => format!(
            ". This is the folder of one set. Try: --data {}",
            folder.display()
        ),
        None => String::new(),
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
