//! GREAT08: constant shear per image, several images of one true shear per set (Bridle et al. 2010, MNRAS 405, 2044).

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use shearq_dataset::threads::{Pool, Progress};
use shearq_files::FileError;
use shearq_files::table::{self, Place};
use shearq_quantities::Shear;
use shearq_scoring::great08;

use crate::agreement::disagreement;
use crate::columns::{Columns, whole, wrong};
use crate::{
    Entry, Figure, Presubmission, Presubmitting, PublicBranch, PublicChallenge, Score, Simulated,
    Simulation, SimulationError, Truth,
};

pub(crate) const CHALLENGE: PublicChallenge = PublicChallenge {
    name: "great08",
    branches: Vec::new,
    simulated: Vec::new,
    branch: |name| match name {
        None => Some(Box::new(Great08)),
        Some(_) => None,
    },
};

#[derive(Debug)]
struct Great08;

// More images than the challenge had (2700), so that a wrong column is noticed.
const MAX_IMAGES: usize = 1_000_000;

const SHEARS: Columns<'static> = Columns {
    names: &[&["image", "set", "index"], &["g1"], &["g2"]],
    required: 3,
    unnamed: &[(3, &[0, 1, 2])],
};

const WITH_SETS: Columns<'static> = Columns {
    names: &[&["image"], &["set"], &["g1"], &["g2"]],
    required: 4,
    unnamed: &[(4, &[0, 1, 2, 3])],
};

// The number of the image or set of row `k`, if it and the shear can be.
fn image_of(path: &Path, k: usize, number: f64, g: Shear) -> Result<usize, FileError> {
    let Some(image) = whole(number, MAX_IMAGES) else {
        let message = format!(
            "row {}: not the number of an image or set (found {number}, expected 0, 1, 2, …)",
            k + 1
        );
        return wrong(path, message);
    };
    if g.modulus().is_nan() || g.modulus() >= 1.0 {
        let message = format!(
            "{image}: not a shear (found {} {}, expected |g| < 1)",
            g.e1, g.e2
        );
        return wrong(path, message);
    }
    Ok(image)
}

// Whether a truth states the set of each image. Its form decides, not whether it can be read: a fault of such a table would be
// reported as that of the other kind.
fn has_sets(path: &Path) -> Result<bool, FileError> {
    let found = table::columns(&Place::of(path))?;
    let is_named =
        |names: &[String], wanted: &str| names.iter().any(|name| name.eq_ignore_ascii_case(wanted));
    let mut named = found.named.iter().map(|own| &own.names);
    Ok(found.unnamed.len() == WITH_SETS.required
        || named.any(|names| is_named(names, "image") && is_named(names, "set")))
}

// Shears by the number of their image or set.
fn read_shears(path: &Path) -> Result<BTreeMap<usize, Shear>, FileError> {
    let columns = SHEARS.read(path)?;
    let mut found = BTreeMap::new();
    for (k, &number) in columns[0].iter().enumerate() {
        let g = Shear::new(columns[1][k], columns[2][k]);
        let image = image_of(path, k, number, g)?;
        if found.insert(image, g).is_some() {
            return wrong(
                path,
                format!("{image} is there twice; expected one row each"),
            );
        }
    }
    if found.is_empty() {
        return wrong(path, "found no row, expected index g1 g2");
    }
    Ok(found)
}

fn read_entry(path: &Path) -> Result<BTreeMap<usize, Shear>, FileError> {
    let shears = read_shears(path)?;
    if let Some((image, _)) = shears.iter().find(|(_, g)| **g == Shear::ZERO) {
        let message = format!("{image}: the shear is exactly zero, which no measurement gives");
        return wrong(path, message);
    }
    let first = shears.values().next();
    if shears.len() > 1 && shears.values().all(|g| Some(g) == first) {
        return wrong(
            path,
            "all shears are the same, as of a method that measures nothing",
        );
    }
    Ok(shears)
}

fn refuse(option: &str, given: bool) -> Result<(), FileError> {
    match given {
        true => {
            Err(FileError::new(option, "GREAT08 has no use for it").hint("without this option"))
        }
        false => Ok(()),
    }
}

impl PublicBranch for Great08 {
    fn title(&self) -> String {
        "GREAT08".into()
    }

    fn subfields(&self) -> Option<usize> {
        None
    }

    // Truth: `image set g1 g2`, or `index g1 g2` where rows with the same true shear are a set. The submission has a row per image
    // or per set.
    fn score(&self, truth: Truth<'_>, submission: &Path, _: &Pool) -> Result<Score, FileError> {
        refuse("--psf", truth.psf.is_some())?;
        refuse("--subfields", truth.subfields.is_some())?;
        let submitted = read_entry(submission)?;
        let images: Vec<(usize, String, Shear)> = match has_sets(truth.path)? {
            true => {
                let own = WITH_SETS.read(truth.path)?;
                let row = |k: usize| {
                    let g = Shear::new(own[2][k], own[3][k]);
                    let image = image_of(truth.path, k, own[0][k], g)?;
                    Ok((image, own[1][k].to_string(), g))
                };
                (0..own[0].len())
                    .map(row)
                    .collect::<Result<_, FileError>>()?
            }
            false => read_shears(truth.path)?
                .into_iter()
                .map(|(image, g)| (image, format!("{} {}", g.e1, g.e2), g))
                .collect(),
        };
        let numbers: BTreeSet<usize> = images.iter().map(|own| own.0).collect();
        let sets: BTreeSet<&String> = images.iter().map(|own| &own.1).collect();
        let named: BTreeSet<String> = submitted.keys().map(usize::to_string).collect();
        let per_set = sets.iter().copied().eq(named.iter()) && sets.len() < numbers.len();
        if !per_set && !numbers.iter().eq(submitted.keys()) {
            let lacking = numbers.iter().find(|own| !submitted.contains_key(own));
            let odd = submitted.keys().find(|own| !numbers.contains(own));
            let which = match (lacking, odd) {
                (Some(image), _) => format!("image {image} is missing"),
                (None, image) => format!("image {} is not in the truth", image.unwrap_or(&0)),
            };
            let message = format!(
                "{which} (found {} rows, expected {} images or {} sets as in {})",
                submitted.len(),
                numbers.len(),
                sets.len(),
                truth.path.display()
            );
            return wrong(submission, message);
        }
        let mut pairs = Vec::new();
        let mut differences: BTreeMap<&String, Vec<Shear>> = BTreeMap::new();
        for (image, set, g) in &images {
            let number = if per_set {
                set.parse().unwrap_or(*image)
            } else {
                *image
            };
            let own = submitted[&number];
            pairs.push((*g, own));
            let difference = Shear::new(own.e1 - g.e1, own.e2 - g.e2);
            differences.entry(set).or_default().push(difference);
        }
        let sets: Vec<Vec<Shear>> = differences.into_values().collect();
        let found = great08::score(&sets).map_err(|error| FileError::new(submission, error))?;
        Ok(Score {
            branch: None,
            refusal: disagreement(&pairs, truth.path),
            warnings: Vec::new(),
            figures: vec![Figure {
                key: "Q",
                value: found.q,
                error: None,
                jackknife: found.jackknife,
                perfect: None,
                // Of a mean square error of 10⁻⁷.
                requirement: Some(1000.0),
                decimals: 1,
            }],
            plots: Vec::new(),
        })
    }

    fn check(&self, submission: &Path, subfields: Option<usize>) -> Result<(), FileError> {
        refuse("--subfields", subfields.is_some())?;
        read_entry(submission).map(|_| ())
    }

    fn pack(&self, _: &Presubmitting<'_>, _: &Pool) -> Option<Result<Presubmission, FileError>> {
        None
    }

    fn simulate(
        &self,
        _: &Simulation<'_>,
        _: usize,
        _: &dyn Fn(u64) -> Box<dyn Progress>,
    ) -> Option<Result<Simulated, SimulationError>> {
        None
    }

    fn leaderboard(&self) -> Vec<Entry> {
        Vec::new()
    }

    fn leaderboard_source(&self) -> Option<&'static str> {
        None
    }
}
