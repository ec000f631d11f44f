//! Messages about odd rows of catalogues, and about probable faults of ellipticities and of the true shear.

use std::path::PathBuf;

use shearq_scoring::{Fault, ImageFaults, OddResponse, RowCounts};

use crate::score::OddImages;

/// A line for each kind of odd row in the catalogues of `whose`: how many there are, and how they are scored.
pub fn oddities(counts: &RowCounts, whose: &str) -> Vec<String> {
    let mut lines = Vec::new();
    if counts.outside + counts.excess > 0 {
        lines.push(format!(
            "warning: {whose} has {} outside the grid and {} beyond the number of cells; they do not count.",
            rows(counts.outside),
            counts.excess
        ));
    }
    if counts.repeated > 0 {
        lines.push(format!(
            "warning: {} of {whose} of galaxies that have one already; they add up.",
            rows(counts.repeated)
        ));
    }
    if counts.missing > 0 {
        lines.push(format!(
            "warning: {} of {} galaxies of {whose} are not in the catalogues; each counts as zero.",
            counts.missing,
            counts.missing + counts.used + counts.not_finite - counts.repeated
        ));
    }
    if counts.above_one > 0 {
        lines.push(format!(
            "warning: {} of {whose} with |e| > 1, {} with |e| > {}; scored unchanged.",
            rows(counts.above_one),
            counts.absurd,
            RowCounts::ABSURD
        ));
    }
    if counts.not_finite > 0 {
        lines.push(format!(
            "note: {} of {} galaxies of {whose} have no ellipticity (NaN, flagged, marked as missing, or a distortion above 1, which noise makes) and count as missing.",
            counts.not_finite,
            counts.not_finite + counts.used
        ));
    }
    lines
}

fn rows(count: usize) -> String {
    format!("{count} row{}", if count == 1 { "" } else { "s" })
}

pub fn words(finding: &Fault) -> String {
    match *finding {
        Fault::StrongTruth { rms } => format!(
            "the true shear is too strong for weak lensing (rms {rms:.3}, expected below 0.3); it may be in percent, or another quantity"
        ),
        Fault::Convention {
            scored,
            correlation,
            better,
            with,
        } => format!(
            "the convention is probably wrong: convention {} ({}) correlates with the true shear by {with:.2}, convention {} only by {correlation:.2}. Check the signs of e1 and e2 and the order of x and y",
            better.number(),
            better.describe(),
            scored.number()
        ),
        Fault::Swapped { correlation, with } => format!(
            "e1 and e2 seem to be swapped: swapped they correlate with the true shear by {with:.2}, as given only by {correlation:.2}. Check the order of the columns"
        ),
        Fault::Shifted {
            x,
            y,
            correlation,
            with,
        } => format!(
            "the ellipticities seem to be shifted by ({x:+}, {y:+}) cells: shifted back they correlate with the true shear by {with:.2}, as given only by {correlation:.2}. Check the order of the rows and the positions"
        ),
        Fault::Uncorrelated {
            correlation,
            allowed,
        } => format!(
            "the ellipticities correlate with the true shear by only {correlation:.2}, but their noise allows {allowed:.2}. Check the order of the rows, the positions, the columns, and that truth and catalogues belong together"
        ),
        Fault::Distortion { m, error } => format!(
            "the ellipticities respond to shear by a factor of {:.2} ± {error:.2}, expected 1: they seem to be distortions χ, not shear-type ε",
            1.0 + m
        ),
        Fault::Biased { m, error } => format!(
            "m = {m:.3} ± {error:.3}, expected |m| below 0.1: a high Q does not make such ellipticities fit for use. Calibrate them"
        ),
    }
}

/// Faults of arrays of images, one sentence each; images count from 1.
pub fn odd_arrays(faults: &ImageFaults) -> Vec<String> {
    let name = |place: usize| PathBuf::from(format!("image {}", place + 1));
    let images: Vec<PathBuf> = (0..faults.images()).map(name).collect();
    odd_images(&OddImages::new(faults, &images))
}

pub fn odd_images(odd: &OddImages) -> Vec<String> {
    let mut lines = Vec::new();
    let more = |count: usize| match count {
        1 => String::new(),
        2 => ", and 1 more likewise".to_owned(),
        _ => format!(", and {} more likewise", count - 1),
    };
    if let Some((copy, first)) = odd.copies.first() {
        lines.push(format!(
            "{} has the ellipticities of {}{}; expected an independent measurement per image. Noise, Q_dn and errors are wrong",
            copy.display(),
            first.display(),
            more(odd.copies.len())
        ));
    }
    if let Some((path, [e1, e2])) = odd.constant.first() {
        lines.push(format!(
            "all galaxies of {} have the ellipticity ({e1}, {e2}){}; expected measured values. Check the column names",
            path.display(),
            more(odd.constant.len())
        ));
    }
    for (path, response) in odd.responses.iter().take(MOST_NAMED) {
        lines.push(format!("{} {}", path.display(), odd_response(response)));
    }
    if let Some(left) = odd.responses.len().checked_sub(MOST_NAMED + 1) {
        let names = odd.responses[MOST_NAMED..].iter().map(|(path, _)| path);
        let names: Vec<String> = names.map(|path| path.display().to_string()).collect();
        lines.push(format!(
            "{} more images likewise: {}",
            left + 1,
            names.join(", ")
        ));
    }
    lines
}

// Chosen by hand: more sentences hide the others.
const MOST_NAMED: usize = 4;

/// How an image differs from the others of its set, with the probable cause.
pub fn odd_response(odd: &OddResponse) -> String {
    let OddResponse {
        response,
        slope,
        correlation,
        ..
    } = odd;
    let ratio = response.slope / slope;
    let cause = match ratio {
        _ if ratio < -0.5 => "Its signs are probably wrong",
        _ if ratio < 0.5 => {
            "Its galaxies are probably in another order, at other positions or of another set"
        }
        _ => "Its ellipticities are probably of another type or scale",
    };
    format!(
        "follows the true shear by {:.2} ± {:.2} (correlation {:.2}), the images of its set by {slope:.2} ({correlation:.2}). {cause}",
        response.slope, response.error, response.correlation
    )
}

/// Findings of several sets, one line per kind: the message of the first set, and the numbers of the other sets.
pub fn of_sets<'a>(sets: impl Iterator<Item = (Option<u32>, &'a [Fault])>) -> Vec<String> {
    let mut kinds: Vec<(Fault, Vec<Option<u32>>)> = Vec::new();
    for (set, findings) in sets {
        for finding in findings {
            let kind = std::mem::discriminant(finding);
            match kinds
                .iter_mut()
                .find(|(first, _)| std::mem::discriminant(first) == kind)
            {
                Some((_, sets)) => sets.push(set),
                None => kinds.push((*finding, vec![set])),
            }
        }
    }
    kinds
        .iter()
        .map(|(finding, sets)| {
            let others: Vec<String> = sets[1..].iter().flatten().map(u32::to_string).collect();
            let others = match others.is_empty() {
                true => String::new(),
                false => format!(" (likewise in set {})", others.join(", ")),
            };
            let advice = match finding {
                Fault::Distortion { .. } => {
                    " Try: --ellipticity distortion, or `ellipticity = \"distortion\"` with --foreign."
                }
                _ => "",
            };
            format!("{}{}{others}.{advice}", prefix(sets[0]), words(finding))
        })
        .collect()
}

/// `warning: set 02: `, or `warning: ` if the set has no number.
pub fn prefix(set: Option<u32>) -> String {
    set.map_or_else(
        || "warning: ".into(),
        |set| format!("warning: set {set:02}: "),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_of_several_sets_is_one_line_with_advice() {
        let distorted = |m| Fault::Distortion { m, error: 0.1 };
        let (two, five) = ([distorted(1.02)], [distorted(0.9)]);
        let sets = [(Some(2), &two[..]), (Some(5), &five[..])];
        let lines = of_sets(sets.into_iter());
        assert_eq!(lines.len(), 1);
        assert!(lines[0].starts_with("warning: set 02: ") && lines[0].contains("2.02 ± 0.10"));
        assert!(lines[0].contains("(likewise in set 5). Try: --ellipticity distortion"));
        assert!(of_sets([(None, &two[..])].into_iter())[0].starts_with("warning: the "));
    }

    fn good() -> RowCounts {
        RowCounts {
            used: 64,
            ..RowCounts::default()
        }
    }

    #[test]
    fn each_kind_of_odd_row_has_a_line() {
        assert!(oddities(&good(), "x").is_empty());
        let odd = RowCounts {
            used: 50,
            outside: 1,
            excess: 2,
            not_finite: 3,
            repeated: 4,
            missing: 15,
            above_one: 5,
            absurd: 2,
            ..RowCounts::default()
        };
        let lines = oddities(&odd, "set 7");
        let expected = [
            "set 7 has 1 row outside the grid and 2 beyond",
            "4 rows of set 7",
            "15 of 64 galaxies of set 7 are not in the catalogues",
            "5 rows of set 7 with |e| > 1, 2 with |e| > 5",
            "3 of 53 galaxies of set 7 have no ellipticity",
        ];
        assert_eq!(lines.len(), expected.len());
        for (line, words) in lines.iter().zip(expected) {
            assert!(line.contains(words), "{line}");
        }
        let (outside, excess) = (
            RowCounts {
                outside: 1,
                ..good()
            },
            RowCounts {
                excess: 1,
                ..good()
            },
        );
        assert_eq!(oddities(&outside, "x").len(), 1);
        assert_eq!(oddities(&excess, "x").len(), 1);
    }
}
