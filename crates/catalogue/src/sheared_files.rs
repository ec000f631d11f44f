//! Files of sheared catalogues, such as `a_noshear.fits` and `a_1p.fits`, which are one catalogue.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use shearq_bias::Range;
use shearq_files::FileError;
use shearq_files::table::{self, Place};

use crate::columns::{Columns, Names};
use crate::expression::Expression;
use crate::recognition::words;
use crate::request::Input;
use crate::roles::{CATALOGUES, Role};
use crate::source::{add_formulas, with_formulas};
use crate::steps::step_of;
use crate::truth::Truth;

// The sheared catalogue that the name of a file or of its folders states, and the path without it. Short words such as `m1` and
// `00` are also those of other things.
fn sheared_path(path: &Path) -> Option<(usize, String)> {
    let words = words(&path.to_string_lossy());
    let all: Vec<&str> = words.trim_matches('_').split('_').collect();
    let is_clear = |word: &str| word.len() > 2 || word.starts_with(['1', '2']);
    let steps = all
        .iter()
        .map(|word| step_of(word).filter(|_| is_clear(word)));
    let mut found = steps.enumerate().filter_map(|(at, step)| Some((at, step?)));
    let (at, step) = found.next_back()?;
    Some((step, [&all[..at], &[""], &all[at + 1..]].concat().join("_")))
}

// Whether a name states an artificial shear of the PSF, as `a_1p_psf.fits` of metacalibration does.
fn is_of_psf(path: &Path) -> bool {
    let words = words(&path.to_string_lossy());
    let all: Vec<&str> = words.trim_matches('_').split('_').collect();
    all.windows(2)
        .any(|pair| pair[1] == "psf" && step_of(pair[0]).is_some_and(|step| step > 0))
}

/// Refuses files of galaxies behind a sheared PSF, which were averaged with the others.
///
/// # Errors
/// If the name of a file states a sheared PSF, and `names` do not decline sheared catalogues.
pub fn refuse_sheared_psfs(catalogues: &[Input], names: &Names) -> Result<(), FileError> {
    let mut files = catalogues.iter().filter(|own| own.frame.is_none());
    match files.find(|own| is_of_psf(&own.name)) {
        Some(own) if !names.is_given(Role::ShearedCatalogue) => {
            let message = "the name states an artificial shear of the PSF (expected files of noshear, 1p, 1m, 2p and 2m)";
            Err(FileError::new(&own.name, message).hint("without the files of a sheared PSF, or --columns version=none if the name states something else"))
        }
        _ => Ok(()),
    }
}

/// What a catalogue lacks whose name states that it has no artificial shear, if no file of the sheared ones is given.
pub fn without_sheared(catalogues: &[Input]) -> Option<String> {
    let is_alone = |own: &&Input| own.frame.is_none() && own.parts.is_empty();
    let mut files = catalogues.iter().filter(is_alone);
    let own = files.find(|own| matches!(sheared_path(&own.name), Some((0, _))))?;
    Some(format!(
        "nothing divides the ellipticities by their response: {} is named as the catalogue without artificial shear, and those of 1p, 1m, 2p and 2m are not given. Try: all five files of each catalogue",
        own.name.display()
    ))
}

/// The catalogues of a list, in which files such as `a_noshear.fits`, `a_1p.fits` and `a_1m.fits` are one catalogue: their mean
/// shears are not those of galaxies. Files with different true shears stay apart, and all if `names` declines sheared catalogues.
pub fn with_sheared_files(catalogues: Vec<Input>, truth: &Truth, names: &Names) -> Vec<Input> {
    if names.is_given(Role::ShearedCatalogue) {
        return catalogues;
    }
    let of_file = |input: &Input| match input.frame.is_none() && input.parts.is_empty() {
        true => sheared_path(&input.name),
        false => None,
    };
    let shear = |input: &Input| match truth {
        Truth::Catalogues(_) => match truth.of_paths([input.name.as_path()]) {
            Ok(Truth::Catalogues(own)) => own.into_values().next(),
            _ => None,
        },
        _ => None,
    };
    let mut groups: BTreeMap<String, BTreeMap<usize, &Input>> = BTreeMap::new();
    let mut repeated = BTreeSet::new();
    for input in &catalogues {
        if let Some((step, rest)) = of_file(input)
            && groups
                .entry(rest.clone())
                .or_default()
                .insert(step, input)
                .is_some()
        {
            repeated.insert(rest);
        }
    }
    let own_shear = |input: &Input| match truth {
        Truth::Columns => shear_of_columns(&input.name, names),
        _ => shear(input),
    };
    // A file without artificial shear and others, or all others: `1p` and `1m` are also names of test shears.
    let known = !matches!(truth, Truth::Columns);
    groups.retain(|rest, files| {
        if repeated.contains(rest) {
            return false;
        }
        let has_all = files.contains_key(&0) || known && files.len() == CATALOGUES - 1;
        if files.len() < 2 || !has_all {
            return false;
        }
        let mut shears = files.values().filter_map(|input| own_shear(input));
        let first = shears.next();
        shears.all(|own| Some(own) == first)
    });
    let joined = |input: &Input| -> Option<Input> {
        let Some(files) = of_file(input).and_then(|(_, rest)| groups.get(&rest)) else {
            return Some(input.clone());
        };
        let parts = files
            .iter()
            .map(|(step, own)| (own.name.clone(), Some(*step)));
        let first = files
            .values()
            .next()
            .is_some_and(|first| first.name == input.name);
        first.then(|| Input {
            parts: parts.collect(),
            ..input.clone()
        })
    };
    catalogues.iter().filter_map(joined).collect()
}

// The true shear that all rows of a file have in columns: files of one shear each are no sheared catalogues, although their names
// are noshear, 1p and 1m. A file that cannot be read is named later.
fn shear_of_columns(path: &Path, names: &Names) -> Option<[f64; 2]> {
    let place = Place::of(path);
    let lists = table::columns(&place).ok()?.named;
    let [list] = &lists[..] else {
        return None;
    };
    let (found, formulas) = with_formulas(path, &list.names, names).ok()?;
    let columns = Columns::find(path, &found, names, false).ok()?;
    let shear = [columns.of(Role::G1)?, columns.of(Role::G2)?];
    let operands = formulas.iter().flat_map(Expression::columns);
    let read = shear.into_iter().chain(operands);
    let read: BTreeSet<&str> = read
        .filter(|own| list.names.iter().any(|name| name == own))
        .collect();
    let read: Vec<&str> = read.into_iter().collect();
    let mut ranges = [Range::default(); 2];
    table::read_parts(&place, &read, &[], |part| {
        let part = add_formulas(part, &formulas, path)?;
        for (range, name) in ranges.iter_mut().zip(shear) {
            let values = table::numbers(&part, name, path)?;
            values.iter().for_each(|value| range.add(*value));
        }
        Ok(())
    })
    .ok()?;
    let [g1, g2] = ranges.map(Range::constant);
    Some([g1?, g2?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_sheared_psfs_are_refused_and_lonely_ones_named() {
        let inputs = |names: &[&str]| -> Vec<Input> {
            let paths = names.iter().map(|name| Path::new(name).to_path_buf());
            paths.map(Input::from).collect()
        };
        let names = Names::default();
        let of_psf = inputs(&["a_noshear.fits", "a_1p_psf.fits"]);
        let error = refuse_sheared_psfs(&of_psf, &names).unwrap_err();
        assert!(error.to_string().starts_with("a_1p_psf.fits: "), "{error}");
        for name in ["a_1p.fits", "psf_1p.fits", "a_psf.fits"] {
            refuse_sheared_psfs(&inputs(&[name]), &names).unwrap();
        }
        assert!(without_sheared(&inputs(&["b.csv", "a_noshear.csv"])).is_some());
        assert!(without_sheared(&inputs(&["a_1p.csv", "b.csv"])).is_none());
    }

    #[test]
    fn files_of_sheared_catalogues_are_one_catalogue() {
        let joined = |names: &[&str], truth: &Truth| -> Vec<(String, Vec<Option<usize>>)> {
            let inputs = names
                .iter()
                .map(|name| Input::from(Path::new(name).to_path_buf()));
            let names = Names::default();
            let found = with_sheared_files(inputs.collect(), truth, &names).into_iter();
            let steps = |input: Input| input.parts.into_iter().map(|(_, step)| step).collect();
            found
                .map(|input| (input.name.display().to_string(), steps(input)))
                .collect()
        };
        let all = [
            "a_noshear.csv",
            "a_1p.csv",
            "a_1m.csv",
            "b.csv",
            "a_2m.csv",
            "a_2p.csv",
        ];
        let found = joined(&all, &Truth::Columns);
        let steps: Vec<Option<usize>> = (0..CATALOGUES).map(Some).collect();
        assert_eq!(
            found,
            [
                ("a_noshear.csv".into(), steps.clone()),
                ("b.csv".into(), vec![])
            ]
        );
        let folders = [
            "x/1p/a.fits",
            "x/noshear/a.fits",
            "x/1m/a.fits",
            "x/2p/a.fits",
            "x/2m/a.fits",
        ];
        assert_eq!(
            joined(&folders, &Truth::Columns),
            [("x/noshear/a.fits".into(), steps)]
        );
        // Catalogues of test shears.
        let four = ["1p.csv", "1m.csv", "2p.csv", "2m.csv"];
        assert_eq!(joined(&four, &Truth::Columns).len(), 4);
        assert_eq!(joined(&four, &Truth::Constant([0.02, 0.0])).len(), 1);
        assert_eq!(joined(&["g_1p.csv", "g_1m.csv"], &Truth::Columns).len(), 2);
        let truth = [("s_noshear.csv", 0.0), ("s_1p.csv", 0.02)]
            .map(|(name, g)| (name.to_owned(), [g, 0.0]));
        let truth = Truth::Catalogues(truth.into_iter().collect());
        assert_eq!(joined(&["s_noshear.csv", "s_1p.csv"], &truth).len(), 2);
    }

    #[test]
    fn files_with_other_true_shears_in_columns_stay_apart() {
        let folder = tempfile::tempdir().unwrap();
        let joined = |rows: [&str; 2], columns: &str| {
            let inputs = [("noshear", rows[0]), ("1p", rows[1])].map(|(step, rows)| {
                let path = folder.path().join(format!("a_{step}.csv"));
                std::fs::write(&path, format!("e1,e2,g1,g2\n{rows}")).unwrap();
                Input::from(path)
            });
            let mut names = Names::default();
            let given = columns.split(',').filter(|own| !own.is_empty());
            given.for_each(|own| names.add(own).unwrap());
            with_sheared_files(inputs.into(), &Truth::Columns, &names).len()
        };
        let plain = "0.1,0.2,0,0\n0.3,0.1,0,0\n";
        let turned = plain.replace(",0,0", ",0.02,0");
        assert_eq!(joined([plain, &turned], ""), 2);
        assert_eq!(joined([plain, plain], ""), 1);
        assert_eq!(joined([plain, &turned], "g1=-g1,g2=-g2"), 2);
        assert_eq!(joined([plain, &turned], "g1=none,g2=none"), 1);
        // Shears of galaxies, of which a sheared catalogue may have others.
        let varying = plain.replacen(",0,0", ",0.02,0", 1);
        assert_eq!(joined([&varying, plain], ""), 1);
    }
}
