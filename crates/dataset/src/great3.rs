//! A branch of GREAT3 as it was released (Mandelbaum et al. 2014, ApJS 212, 5): subfields are sets and epochs are images, both
//! from 0.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_files::FileError;
use shearq_files::open::{SETTINGS, is_there, read_to_string};
use shearq_files::table::{self, MAX_ROWS};
use shearq_scoring::great3::{Identity, NODES_PER_GALAXY};

use crate::files::{self, Files};
use crate::mosaic::{MAX_STAMP, Mosaic};
use crate::pattern::{endings, fill};

// Patterns of the names of released files.
pub const GALAXIES: &str = "image-{set:03}-{image}.fits";
/// Stars of branches with one PSF per subfield and epoch.
pub const STAR_FIELDS: &str = "starfield_image-{set:03}-{image}.fits";
/// Images of one PSF per galaxy, which are not part of the release: users interpolate them.
pub const PSF_IMAGES: &str = "psf_image-{set:03}-{image}.fits";
// Stars all over the field, of branches whose PSF varies.
const STAR_CATALOGUES: &str = "star_catalog-{set:03}.fits";
pub const GALAXY_CATALOGUES: &str = "galaxy_catalog-{set:03}.fits";
/// Of [`Parameters`], without the ending. The last two are part of the truth.
pub const DITHERS: &str = "epoch_dither-{set:03}-{image}";
pub const SUBFIELD_OFFSETS: &str = "subfield_offset-{set:03}";
pub const SHEARS: &str = "shear_params-{set:03}";
pub const PSF_SHAPES: &str = "starshape_parameters-{set:03}-{image}";

// Relative difference of a number in two files of parameters. Chosen by hand: the organisers' formats have six digits or more.
const MAX_ROUNDING: f64 = 1e-5;

/// The name of a file, or its stem, by one of these patterns.
pub fn file_name(pattern: &str, subfield: usize, epoch: usize) -> String {
    fill(pattern, subfield as u32, epoch as u32)
}

/// What a branch has that other data folders do not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BranchLayout {
    /// Whether each galaxy has a partner in its subfield that is rotated by 90°, as in all branches of constant shear.
    pub rotated_pairs: bool,
    /// Whether all stars of a field are stacked. Otherwise the lower-left one is used, which alone is at a known place.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub stacked_stars: bool,
}

/// A folder with the files of a branch: patterns of their names, and what its first catalogue of galaxies states.
pub(crate) struct Found {
    pub(crate) psf_star: &'static str,
    pub(crate) stamp: usize,
    pub(crate) branch: BranchLayout,
}

/// `None` without images and catalogues of the branch.
pub(crate) fn detect(root: &Path) -> Result<Option<Found>, FileError> {
    let images = files::find(root, GALAXIES, endings(GALAXIES), &[])?;
    // Images alone may be anyone's.
    let first = images
        .sets()
        .iter()
        .map(|set| galaxy_catalogue(root, *set))
        .find(|path| is_there(path));
    let Some(path) = first else {
        return Ok(None);
    };
    // The first catalogue stands for all: the stamps of a branch have one side, and its shear is constant or varies in all subfields.
    let galaxies = GalaxyCatalogue::read(&path)?;
    // In the folder of the images, so that a folder of links to released files can have them.
    let interpolated = files::find(root, PSF_IMAGES, endings(PSF_IMAGES), &[])?;
    let psf_star = match interpolated.is_empty() {
        true => STAR_FIELDS,
        false => PSF_IMAGES,
    };
    Ok(Some(Found {
        psf_star,
        stamp: galaxies.stamp()?,
        branch: BranchLayout {
            rotated_pairs: galaxies.have_constant_shear()?,
            stacked_stars: false,
        },
    }))
}

/// Whether the stars of a subfield are all over its field, so that its galaxies have different PSFs.
pub fn has_varying_psf(root: &Path, set: u32) -> bool {
    is_there(&root.join(fill(STAR_CATALOGUES, set, 0)))
}

/// The table of a subfield's galaxies.
pub(crate) fn galaxy_catalogue(root: &Path, set: u32) -> PathBuf {
    root.join(fill(GALAXY_CATALOGUES, set, 0))
}

/// The file with the shift of an epoch.
pub(crate) fn dither_file(root: &Path, set: u32, image: u32) -> PathBuf {
    let [yaml, txt] = Parameters::files(root, &fill(DITHERS, set, image));
    if is_there(&txt) { txt } else { yaml }
}

/// Shift (x, y) in pixels of all galaxies of an epoch, of up to `most` along each axis; zero in branches of a single epoch.
// The challenge's example of a coadd shifts each image by the negative of these numbers.
pub fn dither(root: &Path, set: u32, image: u32, most: f64) -> Result<[f64; 2], FileError> {
    let stem = fill(DITHERS, set, image);
    let Some(found) = Parameters::read(root, &stem)? else {
        let path = dither_file(root, set, image);
        let message = "there is no such file, nor one ending in .txt; expected the dither of this epoch, by which its galaxies are shifted";
        return Err(FileError::new(path, message));
    };
    let dither @ [x, y] = [
        found.number("xdither_pixels")?,
        found.number("ydither_pixels")?,
    ];
    if dither.iter().all(|axis| (-most..=most).contains(axis)) {
        return Ok(dither);
    }
    // Here, not where the stamps are combined, whose error would blame the cutting of the stamps and name no file.
    let message = format!(
        "the dither is ({x}, {y}) px (expected up to {most} along each axis, which keeps galaxies on their stamps)"
    );
    Err(FileError::new(&found.path, message).hint("the released file"))
}

/// Files by subfield and epoch that show which images a branch should have: star fields, dithers and, with the number of the
/// first epoch, catalogues.
pub(crate) fn files_of_epochs(root: &Path) -> Result<[Files; 3], FileError> {
    Ok([
        files::find(root, STAR_FIELDS, endings(STAR_FIELDS), &[])?,
        files::find(root, DITHERS, &[".yaml", ".txt"], &[])?,
        files::find(root, GALAXY_CATALOGUES, endings(GALAXY_CATALOGUES), &[])?,
    ])
}

#[derive(Debug)]
struct Galaxy {
    /// The lower one of the two central pixels along each axis, from 0.
    x: usize,
    y: usize,
    id: Identity,
}

/// Places and identities of the galaxies of a subfield.
#[derive(Debug)]
pub struct GalaxyCatalogue {
    path: PathBuf,
    galaxies: Vec<Galaxy>,
}

impl GalaxyCatalogue {
    pub fn read(path: &Path) -> Result<Self, FileError> {
        const WANTED: [&str; 3] = ["x", "y", "ID"];
        let table = table::read(path, Some(&WANTED), MAX_ROWS)?;
        let column = |name: &str| table::numbers(&table, name, path);
        let (x, y, id) = (column("x")?, column("y")?, column("ID")?);
        // Fractions would be centroids, which the challenge does not state; a column of them was matched by mistake.
        let wrong = |row: usize, name: &str, value: f64| {
            let row = row + 1;
            let message =
                format!("row {row}: {name} is {value}; expected a whole number, 0 or more");
            FileError::new(path, message)
        };
        let whole = |row: usize, name: &str, value: f64| {
            let is_whole = value.fract() == 0.0 && (0.0..1e9).contains(&value);
            is_whole
                .then_some(value as usize)
                .ok_or_else(|| wrong(row, name, value))
        };
        let galaxy = |row: usize| {
            Ok(Galaxy {
                x: whole(row, "x", x[row])?,
                y: whole(row, "y", y[row])?,
                id: Identity::of_number(id[row]).ok_or_else(|| wrong(row, "ID", id[row]))?,
            })
        };
        Ok(GalaxyCatalogue {
            path: path.to_owned(),
            galaxies: (0..x.len()).map(galaxy).collect::<Result<_, FileError>>()?,
        })
    }

    /// Pixels a side of the stamps, which no header states: the distance of neighbours.
    fn stamp(&self) -> Result<usize, FileError> {
        // Not side of the image over √galaxies, because a part of a subfield need not be square.
        let columns: BTreeSet<usize> = self.galaxies.iter().map(|galaxy| galaxy.x).collect();
        let first = columns.first().map(|x| 2 * (x + 1));
        let distance = columns.iter().zip(columns.iter().skip(1));
        let distance = distance.map(|(left, right)| right - left).min();
        let found = distance.or(first).unwrap_or(0);
        if (1..=MAX_STAMP).contains(&found) {
            return Ok(found);
        }
        let message = format!(
            "neighbouring galaxies are {found} pixels apart along x; expected 1 to {MAX_STAMP}"
        );
        Err(FileError::new(&self.path, message))
    }

    /// Whether identities count columns and rows. For variable shear, they are nodes of a lattice with seven per galaxy.
    fn have_constant_shear(&self) -> Result<bool, FileError> {
        let stamp = self.stamp()?;
        Ok(self
            .galaxies
            .iter()
            .all(|Galaxy { x, y, id }| id.place() == (x / stamp, y / stamp)))
    }

    /// The stamp of each row of the table.
    pub fn places(&self, mosaic: &Mosaic) -> Result<Vec<usize>, FileError> {
        let (found, expected) = (self.galaxies.len(), mosaic.galaxies);
        if found != expected {
            let message = format!("{found} galaxies; expected {expected}, one per stamp");
            return Err(FileError::new(&self.path, message));
        }
        // By place: nothing states that the rows of the table are in the order of the stamps.
        let mut taken = vec![false; expected];
        let mut places = Vec::with_capacity(expected);
        for Galaxy { x, y, id } in &self.galaxies {
            // FITS pixels count from 1.
            let place = mosaic.place(*x as f64 + 1.0, *y as f64 + 1.0);
            match place.filter(|place| !std::mem::replace(&mut taken[*place], true)) {
                Some(place) => places.push(place),
                None => {
                    let message = format!(
                        "galaxy {id} at x = {x}, y = {y} is outside the image, or another one is on its stamp; expected one galaxy per stamp of {} pixels",
                        mosaic.stamp
                    );
                    return Err(FileError::new(&self.path, message));
                }
            }
        }
        Ok(places)
    }

    /// Identities in the order of the stamps of subfield `set`.
    pub fn identities(
        &self,
        set: u32,
        branch: BranchLayout,
        mosaic: &Mosaic,
    ) -> Result<Vec<i64>, FileError> {
        let step = match branch.rotated_pairs {
            true => 1,
            false => NODES_PER_GALAXY,
        };
        let mut ids = vec![0; mosaic.galaxies];
        let mut offset = None;
        for (galaxy, place) in self.galaxies.iter().zip(self.places(mosaic)?) {
            let [x, y] = [place % mosaic.columns, place / mosaic.columns].map(|at| step * at);
            // Of variable shear, the first galaxy has the offset of its subfield in the lattice.
            let (dx, dy) = *offset.get_or_insert_with(|| match step {
                1 => (0, 0),
                _ => {
                    let (first_x, first_y) = galaxy.id.place();
                    (first_x.saturating_sub(x), first_y.saturating_sub(y))
                }
            });
            let expected = Identity::new(set as usize, (x + dx, y + dy));
            // Rows in another order, exchanged columns or the catalogue of another subfield would give each galaxy a wrong place on
            // the sky, and hence shears that are correlated with the wrong ones.
            if galaxy.id != expected {
                let Galaxy { x, y, id } = galaxy;
                let message = format!(
                    "the galaxy at x = {x}, y = {y} has the ID {id} (expected {expected}, of its subfield, column and row)"
                );
                return Err(FileError::new(&self.path, message)
                    .hint(format!("the released catalogue of subfield {set}")));
            }
            ids[place] = galaxy.id.number();
        }
        Ok(ids)
    }
}

/// Numbers by name, as the challenge wrote them: YAML of one level, or a line of names after `#` and a line of values.
#[derive(Debug)]
pub struct Parameters {
    pub path: PathBuf,
    numbers: BTreeMap<String, f64>,
}

impl Parameters {
    fn files(folder: &Path, stem: &str) -> [PathBuf; 2] {
        ["yaml", "txt"].map(|ending| folder.join(format!("{stem}.{ending}")))
    }

    /// `None` if the folder has neither `stem`.yaml nor `stem`.txt.
    pub fn read(folder: &Path, stem: &str) -> Result<Option<Self>, FileError> {
        let files = Parameters::files(folder, stem).into_iter();
        let found = files.filter(|path| is_there(path)).map(Parameters::of_file);
        let found: Vec<Self> = found.collect::<Result<_, _>>()?;
        if let [first, second] = found.as_slice() {
            // Both may round.
            let differs = |(name, b): (&String, &f64)| {
                let a = first.numbers.get(name)?;
                let same = (a - b).abs() <= MAX_ROUNDING * a.abs();
                (!same).then(|| format!("`{name}` is {b}; {} has {a}", first.path.display()))
            };
            if let Some(message) = second.numbers.iter().find_map(differs) {
                let message = format!("{message} (expected the same)");
                return Err(FileError::new(&second.path, message).hint("remove one of them"));
            }
        }
        Ok(found.into_iter().next())
    }

    fn of_file(path: PathBuf) -> Result<Self, FileError> {
        let text = read_to_string(&path, SETTINGS)
            .map_err(FileError::doing(&path, "cannot read the parameters"))?;
        let mut lines = text.lines().filter(|line| !line.trim().is_empty());
        let pairs: Vec<(&str, &str)> =
            match lines.clone().next().and_then(|line| line.strip_prefix('#')) {
                Some(names) => {
                    let values = lines.nth(1).unwrap_or_default().split_whitespace();
                    names.split_whitespace().zip(values).collect()
                }
                None => text
                    .split(['\n', ',', '{', '}'])
                    .filter_map(|part| part.split_once(':'))
                    .collect(),
            };
        let mut numbers = BTreeMap::new();
        for (name, value) in pairs {
            let name = name.trim_matches(['"', '\'', ' ']).to_owned();
            let Ok(value) = value.trim().parse() else {
                continue;
            };
            if let Some(first) = numbers.insert(name.clone(), value) {
                let message =
                    format!("`{name}` is there twice (found {first} and {value}, expected one)");
                return Err(FileError::new(path, message));
            }
        }
        Ok(Parameters { path, numbers })
    }

    pub fn number(&self, name: &str) -> Result<f64, FileError> {
        let found = self.numbers.get(name).copied();
        found.ok_or_else(|| FileError::new(&self.path, format!("there is no number `{name}`")))
    }
}
