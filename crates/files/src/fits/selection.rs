//! Which images of a FITS file are meant.

use std::path::Path;

use super::file::{Content, File};
use crate::FileError;

/// Planes of a cube that are read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Planes {
    /// All, because nothing is said of them.
    #[default]
    Unstated,
    Each,
    /// This one, from 1.
    One(usize),
}

/// Images by name (EXTNAME), name and version (EXTVER), or number (the first extension is 1, as of tables), and planes of cubes:
/// `SCI`, `SCI,2`, `4`, `plane=2`, `SCI,2,plane=3`, `plane=all`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Selection {
    /// In any case.
    name: Option<String>,
    version: Option<i64>,
    number: Option<usize>,
    pub planes: Planes,
}

impl Selection {
    /// Reads a selection; the error is what is wrong with it.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "no image is called `{text}` (expected a name, a name and a version as in SCI,2, or a number, and perhaps plane=2 or plane=all)"
            )
        };
        let mut found = Selection::default();
        for part in text.split(',').map(str::trim) {
            if let Some(plane) = part.strip_prefix("plane=") {
                found.planes = match (plane, plane.parse()) {
                    ("all", _) => Planes::Each,
                    (_, Ok(plane @ 1..)) => Planes::One(plane),
                    _ => return Err(wrong()),
                };
                continue;
            }
            let is_first = found.name.is_none() && found.number.is_none();
            match part.parse::<usize>() {
                Ok(number) if is_first => found.number = Some(number),
                Err(_) if is_first && !part.is_empty() => found.name = Some(part.to_owned()),
                Ok(version) if found.name.is_some() && found.version.is_none() => {
                    found.version = Some(version as i64);
                }
                _ => return Err(wrong()),
            }
        }
        Ok(found)
    }

    pub fn has(&self, head: &ImageHead) -> bool {
        let name = |name: &String| name.eq_ignore_ascii_case(&head.name);
        self.name.as_ref().is_none_or(name)
            && self.version.is_none_or(|version| version == head.version)
            && self.number.is_none_or(|number| number == head.number)
    }

    /// Whether it says which images, and not only which planes.
    pub fn names_images(&self) -> bool {
        self.name.is_some() || self.number.is_some()
    }
}

/// What the header of an image says of its place in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageHead {
    /// Of the extension; 0 for the primary image.
    pub number: usize,
    /// EXTNAME; empty if it has none.
    pub name: String,
    /// EXTVER.
    pub version: i64,
}

impl ImageHead {
    pub(super) fn here(file: &File) -> Result<Self, FileError> {
        Ok(ImageHead {
            number: file.number_of_extension(),
            name: file.text("EXTNAME"),
            version: file.number("EXTVER")?.map_or(1, |version| version as i64),
        })
    }

    /// The shortest selection that has this image alone among all of its file.
    pub fn shown(&self, all: &[Self]) -> String {
        let same = |other: &&Self| other.name.eq_ignore_ascii_case(&self.name);
        let of_name: Vec<&Self> = all.iter().filter(same).collect();
        let of_version = of_name.iter().filter(|other| other.version == self.version);
        match (self.name.as_str(), of_name.len(), of_version.count()) {
            ("", ..) => self.number.to_string(),
            (name, 1, _) => name.to_owned(),
            (name, _, 1) => format!("{name},{}", self.version),
            _ => self.number.to_string(),
        }
    }
}

/// The images of a file, in order, without their pixels.
pub fn image_heads(path: &Path) -> Result<Vec<ImageHead>, FileError> {
    let mut file = File::open(path, Content::Image)?;
    let mut found = Vec::new();
    loop {
        if file.is_image()? && !file.sides()?.is_empty() {
            found.push(ImageHead::here(&file)?);
        }
        if !file.next()? {
            return Ok(found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_have_names_versions_numbers_and_planes() {
        let heads = [("SCI", 1), ("ERR", 1), ("SCI", 2), ("", 1), ("SCI", 2)];
        let heads: Vec<ImageHead> = heads
            .into_iter()
            .enumerate()
            .map(|(k, (name, version))| ImageHead {
                number: k + 1,
                name: name.to_owned(),
                version,
            })
            .collect();
        let numbers = |text: &str| {
            let selection = Selection::parse(text).unwrap();
            let has = heads.iter().filter(|head| selection.has(head));
            has.map(|head| head.number).collect::<Vec<_>>()
        };
        assert_eq!(numbers("sci"), [1, 3, 5]);
        assert_eq!(numbers("SCI, 2"), [3, 5]);
        assert_eq!(numbers("4"), [4]);
        assert_eq!(numbers("plane=2").len(), 5);
        let both = Selection::parse("SCI,1,plane=3").unwrap();
        assert_eq!(both.planes, Planes::One(3));
        assert!(both.names_images());
        for wrong in ["", "SCI,x", "4,1", "plane=0", "SCI,1,2", "plane=x"] {
            assert!(Selection::parse(wrong).is_err(), "{wrong}");
        }
        let shown: Vec<String> = heads.iter().map(|head| head.shown(&heads)).collect();
        assert_eq!(shown, ["SCI,1", "ERR", "3", "4", "5"]);
    }
}
