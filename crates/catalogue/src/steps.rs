//! Names of sheared catalogues (noshear, 1p, 1m, 2p, 2m) in names of columns, tables and files, and in texts of rows.

use std::borrow::Cow;

use crate::recognition::{recognition, words};
use crate::roles::CATALOGUES;

/// The catalogue that these words name, 0 for that without shear.
pub fn step_of(words: &str) -> Option<usize> {
    let known = &recognition().steps;
    (0..CATALOGUES).find(|catalogue| known[*catalogue].iter().any(|own| own == words))
}

/// The catalogue that a text names, 0 for that without shear: `ns` in metadetection of LSST, `00` in TXPipe.
pub fn catalogue_named(text: &str) -> Option<usize> {
    // `1+` and `g1-`: a sign at the end.
    let text = text.trim();
    let signed = || {
        let sign = text.chars().last()?;
        let letter = match sign {
            '+' => "p",
            '-' | '−' => "m",
            _ => return None,
        };
        Some(text.trim_end_matches(sign).to_owned() + letter)
    };
    let text = signed().map_or(Cow::Borrowed(text), Cow::Owned);
    step_of(words(&text).trim_matches('_'))
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
    fn texts_name_catalogues_and_other_words_do_not() {
        for (text, catalogue) in [
            ("noshear", 0),
            (" NS ", 0),
            ("00", 0),
            ("1p", 1),
            ("2M", 4),
            ("plus2", 3),
            ("1+", 1),
            ("g2-", 4),
            ("2−", 4),
        ] {
            assert_eq!(catalogue_named(text), Some(catalogue), "{text}");
        }
        for text in [
            "", "0", "galaxy", "1", "p", "psf", "2mass", "plus", "+", "-",
        ] {
            assert_eq!(catalogue_named(text), None, "{text}");
        }
    }
}
