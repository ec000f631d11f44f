//! Names of sheared catalogues (noshear, 1p, 1m, 2p, 2m) in names of columns, tables and files, and in texts of rows.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::columns::{CATALOGUES, Names, Role};
use crate::recognition::{recognition, words};
use crate::request::Input;
use crate::truth::Truth;

fn step_of(words: &str) -> Option<usize> {
    let known = &recognition().steps;
    (0..CATALOGUES).find(|catalogue| known[*catalogue].iter().any(|own| own == words))
}

/// The catalogue that a text names, 0 for that without shear: `ns` in metadetection of LSST, `00` in TXPipe.
pub fn catalogue_named(text: &str) -> Option<usize> {
    step_of(words(text).trim_matches('_'))
}

// The words of a name without the ones of a sheared catalogue, or of the one without shear if `sheared` is false.
fn without_step(name: &str, sheared: bool) -> Option<(usize, String)> {
    let name = words(name);
    let all: Vec<&str> = name.trim_matches('_').split('_').collect();
    for count in [1, 2] {
        for first in 0..(all.len() + 1).saturating_sub(count) {
            let end = first + count;
            let step = step_of(&all[first..end].join("_"));
            if let Some(step) = step.filter(|step| (*step > 0) == sheared) {
                let rest = all[..first].iter().chain(&all[end..]);
                let rest: Vec<&str> = rest.copied().filter(|word| *word != "sheared").collect();
                return (!rest.is_empty()).then(|| (step, rest.join("_")));
            }
        }
    }
    None
}

/// The sheared catalogue that the name of a column contains, with its other words: `e1` of `1p/e1`, and of `e11p`.
pub fn sheared_name(name: &str) -> Option<(usize, String)> {
    without_step(name, true).or_else(|| {
        let name = words(name);
        let name = name.trim_matches('_');
        // Only the shortest names, because `p1` also ends names of other things.
        (1..CATALOGUES).find_map(|catalogue| {
            let step = recognition().steps[catalogue].first()?;
            let rest = name
                .strip_suffix(step)
                .or_else(|| name.strip_prefix(step))?;
            (!rest.is_empty()).then(|| (catalogue, rest.to_owned()))
        })
    })
}

/// The words of the name of a column without those of the unsheared catalogue.
pub fn unsheared(name: &str) -> String {
    match without_step(name, false) {
        Some((_, rest)) => rest,
        None => words(name).trim_matches('_').to_owned(),
    }
}

/// The column of a sheared catalogue, in any spelling: `foo_g1_1p` belongs to `foo_g1` and to `foo_g1_noshear`.
pub fn sheared_column<'f>(found: &'f [String], name: &str, catalogue: usize) -> Option<&'f String> {
    let base = unsheared(name);
    // Most tables have the first spelling, and hundreds of other columns.
    let first = format!("{base}_{}", recognition().steps[catalogue][0]);
    let own = found.iter().find(|own| own.eq_ignore_ascii_case(&first));
    let is_own = |own: &&String| {
        own.len() > base.len()
            && sheared_name(own).is_some_and(|(step, rest)| step == catalogue && rest == base)
    };
    own.or_else(|| found.iter().find(is_own))
}

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
    // A file without artificial shear and others, or all others: `1p` and `1m` are also names of test shears.
    let known = !matches!(truth, Truth::Columns);
    groups.retain(|rest, files| {
        if repeated.contains(rest) {
            return false;
        }
        let mut shears = files.values().filter_map(|input| shear(input));
        let first = shears.next();
        let one_shear = shears.all(|own| Some(own) == first);
        one_shear
            && files.len() > 1
            && (files.contains_key(&0) || known && files.len() == CATALOGUES - 1)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheared_columns_are_found_in_any_spelling() {
        for (e1, e2, plus) in [
            ("e1", "e2", "e1_1p"),
            ("E1", "E2", "E1_1P"),
            ("e1", "e2", "e1_p1"),
            ("e1", "e2", "e1_1plus"),
            ("e1", "e2", "e1_plus_1"),
            ("e1", "e2", "1p_e1"),
            ("e1", "e2", "e11p"),
            ("e1", "e2", "e1.1p"),
            ("00/g1", "00/g2", "1p/g1"),
            ("e1", "e2", "e1_sheared_1p"),
            ("mcal_noshear_e1", "mcal_noshear_e2", "mcal_1p_e1"),
            ("g_noshear[0]", "g_noshear[1]", "g_1p[0]"),
            ("unsheared/e_1", "unsheared/e_2", "sheared_1p/e_1"),
            ("e1_ns", "e2_ns", "e1_1_p"),
        ] {
            let found = [plus.to_owned()];
            assert!(sheared_column(&found, e1, 1).is_some(), "{plus}");
            assert!(sheared_column(&found, e2, 1).is_none(), "{plus}");
            assert!((2..CATALOGUES).all(|k| sheared_column(&found, e1, k).is_none()));
        }
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
    fn texts_name_catalogues_and_other_words_do_not() {
        for (text, catalogue) in [
            ("noshear", 0),
            (" NS ", 0),
            ("00", 0),
            ("1p", 1),
            ("2M", 4),
            ("plus2", 3),
        ] {
            assert_eq!(catalogue_named(text), Some(catalogue), "{text}");
        }
        for text in ["", "0", "galaxy", "1", "p", "psf", "2mass"] {
            assert_eq!(catalogue_named(text), None, "{text}");
        }
    }
}
