//! The true shear of catalogues or galaxies: of all, by catalogue, identifier or position, or of the data that folders of
//! catalogues were measured on.

use std::collections::{BTreeMap, HashMap};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use shearq_dataset::images::Files;
use shearq_dataset::run::{RUN_FILE, Run};
use shearq_dataset::truth::{Sign, SignBasis, sign_on_any_grid, stated_sign};
use shearq_files::open::is_there;
use shearq_files::table::{self, MAX_ROWS, Place, TRUTH_COLUMNS};
use shearq_files::{FileError, names_of};
use shearq_scoring::{Row, TruthSign};

use crate::identity;
use crate::input::Input;
use crate::recognition::names_of_role;
use crate::roles::{Places, Role};

#[derive(Debug, Clone, Default)]
pub enum Truth {
    /// From columns of the catalogues, if there are any.
    #[default]
    Columns,
    /// All catalogues have one shear.
    Constant([f64; 2]),
    /// A shear per catalogue, by its path or parts of it: the name of its file or of a folder above.
    Catalogues(BTreeMap<String, [f64; 2]>),
    /// A shear per galaxy, by the key of its identifier.
    Galaxies(Arc<HashMap<u64, [f64; 2]>>),
    /// A shear per galaxy, by its position.
    Positions(Arc<Positions>),
    /// A shear per galaxy of each catalogue, by its position.
    Data(BTreeMap<PathBuf, Arc<Positions>>),
}

/// The sign of g2 in a [`Truth`].
#[derive(Debug, Clone, Default, PartialEq)]
pub enum TrueSign {
    /// Standard: shears of options, of columns of the catalogues, and of data folders.
    #[default]
    Convention,
    Known(Sign),
    /// The catalogues must determine the sign of this file.
    OfCatalogues(PathBuf),
}

impl TrueSign {
    /// The sign that was specified, else the standard one.
    pub fn or_standard(specified: Option<TruthSign>) -> Self {
        let basis = SignBasis::Specified;
        specified.map_or(TrueSign::Convention, |of| {
            TrueSign::Known(Sign { of, basis })
        })
    }
}

const CATALOGUE: [&str; 3] = ["catalogue", "catalog", "file"];

impl Truth {
    /// Reads a table of true shears: columns `catalogue g1 g2` (text), or `id g1 g2` or `x y g1 g2` in any format, with
    /// the sign of its g2. The shears themselves are as in the file.
    pub fn read(path: &Path, specified: Option<TruthSign>) -> Result<(Self, TrueSign), FileError> {
        let place = Place::of(path);
        let columns = table::columns(&place)?;
        // A table with a shear per catalogue is typed by the user, as --g1 and --g2 are; another one must have a sign.
        let sign = |undetermined: Option<TrueSign>, by_modes: &dyn Fn() -> Option<TruthSign>| {
            let found = Sign::of_truth(stated_sign(&place.path)?, specified, by_modes)
                .map_err(|fault| FileError::new(path, fault))?;
            Ok(found.map_or(undetermined.unwrap_or_default(), TrueSign::Known))
        };
        // Names in any case: FITS writers like capitals.
        let named = |name: &str| {
            let mut names = columns.named.iter().flat_map(|list| &list.names);
            names
                .find(|own| own.eq_ignore_ascii_case(name))
                .map(String::as_str)
        };
        let unclear = Some(TrueSign::OfCatalogues(path.to_owned()));
        let shears = named("g1").zip(named("g2"));
        let positions = named("x").zip(named("y"));
        let catalogue = CATALOGUE.iter().find_map(|name| named(name));
        let other = || names_of_role(Role::Id).find_map(named);
        let id = named("id").or_else(|| other().filter(|_| positions.is_none()));
        let key = catalogue.or(id);
        if let (Some(_), None, Some(_)) = (shears, key, positions) {
            let positions = Positions::read(path, TruthSign::Standard)?;
            positions.check_distances(path)?;
            let sign = sign(unclear, &|| positions.sign_by_modes())?;
            return Ok((Truth::Positions(Arc::new(positions)), sign));
        }
        let (Some((name1, name2)), Some(key)) = (shears, key) else {
            let found: Vec<&String> = columns.named.iter().flat_map(|list| &list.names).collect();
            return Err(FileError::new(
                path,
                format!(
                    "this is no table of true shears (found {}, expected the columns id, g1, g2 or x, y, g1, g2 or catalogue, g1, g2)",
                    names_of(&found)
                ),
            ));
        };
        let (mut galaxies, mut catalogues) = (HashMap::new(), BTreeMap::new());
        let mut before = 0;
        table::read_parts(&place, &[key, name1, name2], &[key], |part| {
            let column = |name| table::numbers(&part, name, path);
            let (g1, g2) = (column(name1)?, column(name2)?);
            let keys = identity::keys(&part, key, path)?;
            for (row, hash) in keys.into_iter().enumerate() {
                let number = before + row + 1;
                let fault = |fault: String| FileError::new(path, format!("row {number}: {fault}"));
                let shear = [g1[row], g2[row]];
                check(shear).map_err(fault)?;
                // Names of catalogues are parts of paths, which hashes are not.
                let name = || identity::text(&part, key, row);
                let (earlier, what) = match catalogue {
                    Some(_) => (catalogues.insert(name(), shear), "catalogue"),
                    None => (galaxies.insert(hash, shear), "identifier"),
                };
                if earlier.is_some() {
                    return Err(fault(format!("the {what} {} occurs twice", name())));
                }
            }
            before += part.height();
            Ok(())
        })?;
        Ok(match catalogue {
            Some(_) => (Truth::Catalogues(catalogues), sign(None, &|| None)?),
            None => (
                Truth::Galaxies(Arc::new(galaxies)),
                sign(unclear, &|| None)?,
            ),
        })
    }

    /// A number that other true shears do not have. Those of data folders are known by the fingerprints of the data.
    pub fn content(&self) -> u64 {
        let of = |key: u64, shear: [f64; 2]| {
            let numbers = shear.iter();
            numbers.fold(key, |key, g| identity::hash(key ^ g.to_bits()))
        };
        let sum = |all: &mut dyn Iterator<Item = u64>| all.fold(0, u64::wrapping_add);
        match self {
            Truth::Columns | Truth::Data(_) => 0,
            Truth::Constant(shear) => of(0, *shear),
            Truth::Catalogues(all) => {
                let key = |name: &String| identity::of_text(name);
                sum(&mut all.iter().map(|(name, shear)| of(key(name), *shear)))
            }
            Truth::Galaxies(all) => sum(&mut all.iter().map(|(key, shear)| of(*key, *shear))),
            Truth::Positions(all) => sum(&mut all.entries.iter().map(|own| {
                let key = identity::hash(own.x.to_bits()) ^ own.y.to_bits();
                of(identity::hash(key), own.shear)
            })),
        }
    }

    /// The same with the shear of each of `catalogues` by its path, if catalogues have a shear each.
    pub fn of_paths<'p>(
        &self,
        catalogues: impl IntoIterator<Item = &'p Path>,
    ) -> Result<Self, FileError> {
        let Truth::Catalogues(all) = self else {
            return Ok(self.clone());
        };
        let (mut found, mut files) = (BTreeMap::new(), BTreeMap::new());
        for path in catalogues {
            let name = row_of(all.keys(), path)?;
            let is_file = Path::new(name).file_name() == path.file_name();
            if let Some(other) = files.insert(name, path).filter(|_| is_file) {
                let message = format!(
                    "`{name}` in the table of true shears is this catalogue and {}; expected one",
                    other.display()
                );
                return Err(FileError::new(path, message).hint("the folder before the name"));
            }
            found.insert(path.display().to_string(), all[name]);
        }
        Ok(Truth::Catalogues(found))
    }
}

#[derive(Debug, Clone, Copy)]
pub enum OfRows<'a> {
    // Zero without a true shear.
    Constant([f64; 2]),
    Identifiers(&'a HashMap<u64, [f64; 2]>),
    Positions(&'a Positions, [usize; 2]),
    Columns([usize; 2]),
}

impl<'a> OfRows<'a> {
    pub fn new(path: &Path, places: &Places, truth: &'a Truth) -> Result<Self, FileError> {
        let absent = |what: &str, option: &str| {
            let message = format!("the catalogue has no {what} to find the true shear with");
            FileError::new(path, message).hint(format!("--columns {option}"))
        };
        let by_position = |positions| {
            let columns = places.pair([Role::X, Role::Y]);
            let columns = columns.ok_or_else(|| absent("positions", "x=NAME,y=NAME"))?;
            Ok(OfRows::Positions(positions, columns))
        };
        match truth {
            Truth::Constant(shear) => Ok(OfRows::Constant(*shear)),
            Truth::Catalogues(all) => {
                let shear = all.get(&path.display().to_string());
                Ok(OfRows::Constant(shear.copied().unwrap_or_default()))
            }
            Truth::Galaxies(galaxies) => match places.of((Role::Id, 0)) {
                Some(_) => Ok(OfRows::Identifiers(galaxies)),
                None => Err(absent("identifier", "id=NAME")),
            },
            Truth::Positions(positions) => by_position(positions),
            Truth::Data(all) => match all.get(path) {
                Some(positions) => by_position(positions),
                None => Err(FileError::new(
                    path,
                    "this catalogue has no known true shear, but the folders have one",
                )
                .hint("separate commands, or --truth FILE")),
            },
            Truth::Columns => Ok(match places.pair([Role::G1, Role::G2]) {
                Some(columns) => OfRows::Columns(columns),
                None => OfRows::Constant([0.0; 2]),
            }),
        }
    }

    pub fn may_lack_rows(self) -> bool {
        matches!(self, OfRows::Identifiers(..) | OfRows::Positions(..))
    }
}

// The name among `names` that is the path of a catalogue, or the longest one that is a part of it.
fn row_of<'n>(
    names: impl IntoIterator<Item = &'n String>,
    path: &Path,
) -> Result<&'n String, FileError> {
    // `FILE[TABLE]` is also meant by the name of the file.
    let whole = Place::of(path).path;
    // `./a.csv` is `a.csv`, and a table may have absolute paths.
    let there = |own: &Component<'_>| *own != Component::CurDir;
    let absolute = [path, &whole].map(|own| std::path::absolute(own).unwrap_or_default());
    let parts = |path| Path::components(path).filter(there).collect::<Vec<_>>();
    let same = [path, &whole].map(parts);
    let same_absolute = [&*absolute[0], &*absolute[1]].map(parts);
    let (mut best, mut length, mut all) = (Vec::new(), 0, Vec::new());
    for name in names {
        all.push(name);
        let own = parts(Path::new(name));
        if own.is_empty() {
            continue;
        }
        let part = |parts: &Vec<_>| parts.windows(own.len()).any(|some| some == own);
        // A folder above that of the command is no part of a relative path.
        let is_absolute = Path::new(name).is_absolute();
        let fits = same.iter().any(part) || is_absolute && same_absolute.iter().any(part);
        if own.len() < length || !fits {
            continue;
        }
        if own.len() > length {
            (length, best) = (own.len(), Vec::new());
        }
        best.push(name);
    }
    match best[..] {
        [one] => Ok(one),
        [] => Err(FileError::new(
            path,
            format!(
                "the table of true shears does not contain this catalogue (found {}; expected this path, the name of the file, or a folder of it)",
                names_of(&all)
            ),
        )),
        [first, second, ..] => {
            let message = format!(
                "`{first}` and `{second}` in the table of true shears both fit this catalogue; expected one"
            );
            Err(FileError::new(path, message).hint("longer names"))
        }
    }
}

// Largest distance of a galaxy from its place in the truth, in pixels: centroids of detections differ by less, and first
// pixels of 0 and of 1 by more.
pub(crate) const RADIUS: f64 = 1.0;

// Places that are looked at, and the part of them that may have another shear within [`RADIUS`]: at 100 galaxies per arcmin² on
// pixels of 0.2 arcsec, 0.3 % have one. Chosen by hand.
const SAMPLED_PLACES: usize = 4096;
const MAX_NEAR: f64 = 0.1;

#[derive(Debug, Clone, Copy)]
struct Entry {
    x: f64,
    y: f64,
    shear: [f64; 2],
}

impl Entry {
    // Square of side [`RADIUS`] that contains the place: row and column.
    fn cell(&self) -> (i64, i64) {
        (
            (self.y / RADIUS).floor() as i64,
            (self.x / RADIUS).floor() as i64,
        )
    }
}

#[derive(Debug, Clone, Default)]
pub struct Positions {
    /// In the order of their cells.
    entries: Vec<Entry>,
}

impl Positions {
    /// Reads a table with the columns x, y (pixels), g1 and g2 of this sign.
    pub fn read(path: &Path, sign: TruthSign) -> Result<Self, FileError> {
        let place = Place::of(path);
        let found = table::columns(&place)?;
        let names = TRUTH_COLUMNS.map(|name| {
            let mut all = found.named.iter().flat_map(|list| &list.names);
            let own = all.find(|own| own.eq_ignore_ascii_case(name));
            own.map_or(name, String::as_str)
        });
        let read = table::read_from(&place, Some(&names), MAX_ROWS)?;
        let column = |k: usize| table::numbers(&read, names[k], path);
        let [xs, ys, g1, g2] = [column(0)?, column(1)?, column(2)?, column(3)?];
        let factor = match sign {
            TruthSign::Standard => 1.0,
            TruthSign::Challenge => -1.0,
        };
        let mut entries = Vec::with_capacity(xs.len());
        for row in 0..xs.len() {
            let fault = |fault: String| FileError::new(path, format!("row {}: {fault}", row + 1));
            let (x, y) = (xs[row], ys[row]);
            if !(x.is_finite() && y.is_finite()) {
                return Err(fault(format!(
                    "found the position {x}, {y}, expected numbers"
                )));
            }
            let shear = [g1[row], factor * g2[row]];
            check(shear).map_err(fault)?;
            entries.push(Entry { x, y, shear });
        }
        // Sorted by cells, so that a nearest place is found by bisection in a table of any size.
        entries.sort_by(|a, b| {
            let places = || a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y));
            a.cell().cmp(&b.cell()).then_with(places)
        });
        // A table of several images, or of several catalogues: the first shear would be used for all of them.
        let contradictory = |pair: &&[Entry]| {
            (pair[0].x, pair[0].y) == (pair[1].x, pair[1].y) && pair[0].shear != pair[1].shear
        };
        if let Some([a, b]) = entries.windows(2).find(contradictory) {
            let message = format!(
                "the position x = {}, y = {} has two true shears (found {:?} and {:?}, expected one)",
                a.x, a.y, a.shear, b.shear
            );
            return Err(FileError::new(path, message)
                .hint("a table per catalogue, or the columns id, g1, g2"));
        }
        Ok(Positions { entries })
    }

    // The sign of g2 in which the shears are an E-mode field; `None` if they do not fill a square grid.
    fn sign_by_modes(&self) -> Option<TruthSign> {
        let rows = self.entries.iter().map(|entry| Row {
            x: entry.x,
            y: entry.y,
            e1: entry.shear[0],
            e2: entry.shear[1],
        });
        sign_on_any_grid(&rows.collect::<Vec<_>>())
    }

    /// Refuses a table in which many places have another shear within [`RADIUS`], as those in degrees have.
    fn check_distances(&self, path: &Path) -> Result<(), FileError> {
        let step = self.entries.len().div_ceil(SAMPLED_PLACES).max(1);
        let sampled = self.entries.iter().step_by(step);
        let is_near = |own: &&Entry| {
            let mut near = self.near([own.x, own.y]);
            near.any(|(_, other, _)| other.shear != own.shear)
        };
        let (count, near) = (sampled.clone().count(), sampled.filter(is_near).count());
        if near as f64 <= MAX_NEAR * count as f64 {
            return Ok(());
        }
        Err(FileError::new(
            path,
            format!(
                "{:.0} % of the places have another true shear within {RADIUS} (found by x and y, expected pixels, in which galaxies lie farther apart). Degrees or arc minutes?",
                100.0 * near as f64 / count as f64
            ),
        )
        .hint("x and y in pixels in this table and the catalogues, or the columns id, g1, g2"))
    }

    // Places within [`RADIUS`], with their distances.
    fn near(&self, [x, y]: [f64; 2]) -> impl Iterator<Item = (usize, &Entry, f64)> {
        let own = Entry {
            x,
            y,
            shear: [0.0; 2],
        };
        let (row, column) = own.cell();
        let of_row = move |row: i64| {
            let first = self
                .entries
                .partition_point(|e| e.cell() < (row, column - 1));
            let near = self.entries.iter().enumerate().skip(first);
            near.take_while(move |(_, e)| e.cell() <= (row, column + 1))
        };
        let all = (row - 1..=row + 1).flat_map(of_row);
        let all = all.map(move |(place, e)| (place, e, (e.x - x).hypot(e.y - y)));
        all.filter(|(_, _, distance)| *distance <= RADIUS)
    }

    pub fn len(&self) -> usize {
        self.entries.len()
    }

    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The number of the nearest place within [`RADIUS`], of several the first.
    pub fn find(&self, place: [f64; 2]) -> Option<usize> {
        let nearest = self.near(place).min_by(|a, b| a.2.total_cmp(&b.2));
        nearest.map(|(place, ..)| place)
    }

    /// The number of the nearest place within [`RADIUS`], and its shear.
    pub fn at(&self, position: [f64; 2]) -> Option<(usize, [f64; 2])> {
        let nearest = self.find(position);
        nearest.map(|place| (place, self.entries[place].shear))
    }
}

pub fn check([g1, g2]: [f64; 2]) -> Result<(), String> {
    // Without the square root: this is checked in every row.
    if g1 * g1 + g2 * g2 < 1.0 {
        return Ok(());
    }
    Err(format!(
        "this is no shear (found g1 {g1} and g2 {g2}, expected a modulus below 1)"
    ))
}

#[derive(Debug)]
pub struct Expanded {
    pub catalogues: Vec<Input>,
    pub truth: Truth,
    /// Remarks about images of the data that have no catalogue.
    pub without_catalogue: Vec<String>,
}

/// Replaces folders of results by their catalogues, in the order of sets and images. Unless `truth` states the true
/// shear, it is read from the data folders, if they have one.
pub fn expand(paths: &[PathBuf], mut truth: Truth) -> Result<Expanded, FileError> {
    let (mut catalogues, mut without_catalogue) = (Vec::new(), Vec::new());
    let mut found = match &mut truth {
        Truth::Data(found) => std::mem::take(found),
        _ => BTreeMap::new(),
    };
    // One catalogue with a true shear and one without have no common bias.
    let mut without: Option<&Path> = None;
    for path in paths {
        if !path.is_dir() {
            catalogues.push(path.clone().into());
            continue;
        }
        let Some(run) = Run::read(path)? else {
            let parts = parts_of_folder(path)?;
            if parts.is_empty() {
                let message = format!(
                    "this folder has no {RUN_FILE} (expected catalogues, or a folder that `measure` or `run` wrote)"
                );
                return Err(FileError::new(path, message).hint(format!("{}/*", path.display())));
            }
            catalogues.push(Input {
                name: path.clone(),
                parts: parts.into_iter().map(|part| (part, None)).collect(),
                ..Input::default()
            });
            continue;
        };
        let files = run.catalogues(path, &[])?;
        if files.is_empty() {
            return Err(FileError::new(path, "there is no catalogue in this folder"));
        }
        without_catalogue.extend(images_without_catalogue(&run, path, &files)?);
        for set in files.sets() {
            let own: Vec<PathBuf> = files
                .of_set(set)
                .into_iter()
                .map(|(_, file)| file)
                .collect();
            if matches!(truth, Truth::Columns | Truth::Data(_)) {
                match of_data(&run, path, set)? {
                    None => without = Some(path),
                    Some(positions) => {
                        let positions = Arc::new(positions);
                        found.extend(own.iter().map(|file| (file.clone(), positions.clone())));
                    }
                }
            }
            catalogues.extend(own.into_iter().map(Input::from));
        }
    }
    if !found.is_empty() {
        if let Some(path) = without {
            let message = "its data have no true shear, but the data of other folders have one";
            return Err(FileError::new(path, message).hint("separate commands, or --truth FILE"));
        }
        truth = Truth::Data(found);
    }
    Ok(Expanded {
        catalogues,
        truth,
        without_catalogue,
    })
}

// The files of a catalogue in a folder: HATS has them in `dataset`, in folders of orders and pixels, and dask and Spark write
// `table.parquet/part.0.parquet`. Other folders may contain several catalogues.
fn parts_of_folder(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let is_parquet = |path: &Path| path.extension().is_some_and(|own| own == "parquet");
    let dataset = folder.join("dataset");
    let (mut folders, mut files) = match dataset.is_dir() {
        true => (vec![dataset], Vec::new()),
        false if is_parquet(folder) => (vec![folder.to_owned()], Vec::new()),
        false => return Ok(Vec::new()),
    };
    while let Some(folder) = folders.pop() {
        let cannot = || FileError::doing(&folder, "cannot read the folder");
        for entry in std::fs::read_dir(&folder).map_err(cannot())? {
            let path = entry.map_err(cannot())?.path();
            // `_metadata` and `_common_metadata` have no rows.
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            match () {
                () if name.starts_with(['_', '.']) => {}
                () if path.is_dir() => folders.push(path),
                () if is_parquet(&path) => files.push(path),
                () => {}
            }
        }
    }
    files.sort();
    Ok(files)
}

// A bias of fewer images than the data have is valid, but the reader must know.
fn images_without_catalogue(
    run: &Run,
    folder: &Path,
    catalogues: &Files,
) -> Result<Vec<String>, FileError> {
    // Data that are gone are refused where their true shear is needed. Of epochs, one image of a set has a catalogue.
    let Some(data) = run.source.data(folder).ok().filter(|_| !run.epochs) else {
        return Ok(Vec::new());
    };
    let images = data.images(&[])?;
    let of_set = |set: u32| {
        let measured = catalogues.of_set(set);
        let own = images.of_set(set);
        let absent = own
            .iter()
            .filter(|(image, _)| measured.iter().all(|(measured, _)| measured != image));
        let absent = absent.count();
        (absent > 0).then(|| {
            format!(
                "{}: {absent} of {} images of set {set} have no catalogue, so that their galaxies do not count.",
                folder.display(),
                own.len()
            )
        })
    };
    Ok(images.sets().into_iter().filter_map(of_set).collect())
}

fn of_data(run: &Run, folder: &Path, set: u32) -> Result<Option<Positions>, FileError> {
    let data = run.source.data(folder).map_err(|error| {
        let message = format!("the data with the true shear are gone ({error})");
        FileError::new(folder, message)
            .hint("--truth FILE, or the catalogues themselves without a true shear")
    })?;
    let path = data.truth(set);
    if !is_there(&path) {
        return Ok(None);
    }
    Positions::read(&path, data.truth_sign(set)?).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_place_within_a_pixel_is_found_across_cells() {
        let places = [
            (0.1, 0.1),
            (0.9, 0.1),
            (10.0, 10.0),
            (-0.4, -0.4),
            (10.0, 11.5),
        ];
        let mut entries: Vec<Entry> = places
            .iter()
            .enumerate()
            .map(|(k, &(x, y))| Entry {
                x,
                y,
                shear: [k as f64, 0.0],
            })
            .collect();
        entries.sort_by_key(Entry::cell);
        let found = Positions { entries };
        for (position, expected) in [
            ([0.1, 0.1], Some(0.0)),
            ([0.6, 0.2], Some(1.0)),
            ([-0.2, -0.2], Some(3.0)),
            ([10.9, 10.2], Some(2.0)),
            ([9.2, 9.5], Some(2.0)),
            ([10.0, 10.8], Some(4.0)),
            ([11.1, 10.0], None),
            ([5.0, 5.0], None),
        ] {
            assert_eq!(
                found.at(position).map(|(_, g)| g[0]),
                expected,
                "{position:?}"
            );
        }
    }

    #[test]
    fn places_in_degrees_are_refused() {
        let check = |scale: f64| {
            let entries = (0..400).map(|k| Entry {
                x: scale * f64::from(k % 20),
                y: scale * f64::from(k / 20),
                shear: [f64::from(k) * 1e-4, 0.0],
            });
            let mut entries: Vec<Entry> = entries.collect();
            entries.sort_by_key(Entry::cell);
            let found = Positions { entries };
            let check = found.check_distances(Path::new("t"));
            check.map_err(|error| error.to_string())
        };
        check(48.0).unwrap();
        let error = check(0.01).unwrap_err();
        assert!(error.contains("100 % of the places"), "{error}");
    }

    // The shears of catalogues by a table of names, or why they are not known.
    fn shears(table: &[(&str, f64)], catalogues: &[&str]) -> Result<Vec<f64>, String> {
        let table = table.iter().map(|(name, g)| ((*name).to_owned(), [*g; 2]));
        let truth = Truth::Catalogues(table.collect());
        let truth = truth.of_paths(catalogues.iter().map(Path::new));
        let truth = truth.map_err(|error| error.to_string())?;
        let Truth::Catalogues(all) = truth else {
            panic!("{truth:?}");
        };
        Ok(catalogues.iter().map(|path| all[*path][0]).collect())
    }

    #[test]
    fn catalogues_are_named_by_paths_files_or_folders() {
        let (plus, minus) = ("out/plus/set01/c-1.parquet", "out/minus/set01/c-1.parquet");
        let more = "out/plus/set01/c-2.parquet";
        for names in [
            [plus, minus],
            ["plus", "minus"],
            ["out/plus", "out/minus/set01"],
            // The longest name counts.
            ["out", "minus/set01/c-1.parquet"],
            ["./out/plus", "./out/minus/set01/c-1.parquet"],
        ] {
            let table = [(names[0], 0.02), (names[1], -0.02)];
            let found = shears(&table, &[plus, more, minus]);
            match names[0] == plus {
                true => assert!(
                    found
                        .unwrap_err()
                        .contains("does not contain this catalogue")
                ),
                false => assert_eq!(found.unwrap(), [0.02, 0.02, -0.02]),
            }
        }
        assert_eq!(shears(&[("c-1.parquet", 0.01)], &[plus]).unwrap(), [0.01]);
        let absolute = std::path::absolute(plus).unwrap();
        let absolute = absolute.to_str().unwrap();
        assert_eq!(shears(&[(absolute, 0.01)], &[plus]).unwrap(), [0.01]);
        for (table, reason) in [
            (vec![("c-1.parquet", 0.01)], "expected one. Try: the folder"),
            (
                vec![("plus", 0.01), ("minus", 0.0), ("out", 0.0)],
                "both fit",
            ),
            (
                vec![("plus", 0.01), ("inus", 0.0), ("", 0.0)],
                "found , inus, plus",
            ),
        ] {
            let found = shears(&table, &[plus, minus]).unwrap_err();
            assert!(found.contains(reason), "{reason}: {found}");
        }
    }
}
