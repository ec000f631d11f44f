//! Scores as tables and as JSON.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use shearq_scoring::{
    BINS, Bias, BiasFits, Choice, ConventionClass, ConventionScore, Definition, Figures,
    MAX_GROUPS, Quality, SCORED, SetScore,
};

use super::table::{Cell, Heading, Table};
use crate::pipeline::score::{ScoredSet, means};
use crate::simulate::kinds::SetKind;

/// Figures of a table: key, heading, decimals, place in [`Figures::values`], and whether it is one of
/// the columns of detail.
const COLUMNS: [(&str, &str, usize, usize, bool); 11] = [
    ("q", "Q", 2, 0, false),
    ("q_dn", "Q_dn", 2, 1, false),
    ("m_half", "M/2", 4, 2, false),
    ("sqrt_a", "√A×10⁴", 4, 3, false),
    ("m_cross", "m (cross)", 4, 4, false),
    ("m1", "m1", 4, 5, true),
    ("m2", "m2", 4, 6, true),
    ("c1", "c1", 5, 7, true),
    ("c2", "c2", 5, 8, true),
    ("b_power", "B mode×10⁹", 3, 9, true),
    ("eb_power", "EB×10⁹", 3, 10, true),
];

fn figure_cells(figures: &Figures, errors: Option<&Figures>) -> Vec<Cell> {
    let values = figures.values();
    let errors = errors.map(Figures::values);
    COLUMNS
        .iter()
        .map(|&(_, _, decimals, at, _)| {
            Cell::with_error(values[at], errors.map(|e| e[at]), decimals)
        })
        .collect()
}

/// What a set is called in tables.
fn kind_label(set: u32) -> String {
    SetKind::of(set).map_or_else(String::new, |kind| kind.image.label().to_owned())
}

/// One line that says what the figures are.
pub(super) fn definition_note(definition: Definition, choice: Choice) -> String {
    let definition = match definition {
        Definition::Leaderboard => "leaderboard definition (the challenge's own arithmetic)",
        Definition::Corrected => "corrected definition (azimuthal averages, fixed bins)",
    };
    let choice = match choice {
        Choice::Matched => "the convention that correlates best with the truth".to_owned(),
        Choice::Best => "the convention with the highest Q, as the leaderboard took it".to_owned(),
        Choice::Insist(k) => format!("convention {} ({})", k.number(), k.describe()),
    };
    format!(
        "Figures: {definition}; {choice}. Errors: delete-one jackknife over up to {MAX_GROUPS} groups of images. √A in 10⁻⁴ for C_ℓ in steradian."
    )
}

/// Warnings about sets whose leaderboard Q comes from a wrong convention, or whose truth looks
/// misread.
pub fn warnings(scored: &[ScoredSet]) -> Vec<String> {
    let mut lines = Vec::new();
    for ScoredSet {
        set, score, rows, ..
    } in scored
    {
        let name = if *set == 0 {
            "this set".to_owned()
        } else {
            format!("set {set}")
        };
        let (correlation, clear) = score.match_with_truth();
        if rows.used == 0 {
            lines.push(format!(
                "Warning: no galaxy of {name} has an ellipticity; its figures are those of an empty submission."
            ));
        } else if !clear && !matches!(score.choice, Choice::Insist(_)) {
            lines.push(format!(
                "Warning: no convention clearly correlates with the truth in {name} (best {correlation:.2}, convention {}): too much noise to tell; --convention sets one.",
                score.matched.number()
            ));
        } else if clear && score.wrong_convention_wins() {
            let (best, matched) = (
                &score.conventions[score.best.index()],
                &score.conventions[score.matched.index()],
            );
            lines.push(format!(
                "Warning: in {name} the leaderboard takes convention {} ({}) with Q = {:.2}, but convention {} ({}) matches the truth, with Q = {:.2}.",
                best.convention.number(),
                best.convention.describe(),
                best.quality.q,
                matched.convention.number(),
                matched.convention.describe(),
                matched.quality.q
            ));
        }
        if score.true_b_share() > 0.2 {
            lines.push(format!(
                "Warning: {:.0} % of the true power of {name} is in B modes; its g2 may have the other sign (--truth-sign).",
                100.0 * score.true_b_share()
            ));
        }
        if rows.outside + rows.excess > 0 {
            lines.push(format!(
                "Warning: {name} has {} rows outside the grid and {} beyond the number of cells; they do not count.",
                rows.outside, rows.excess
            ));
        }
        if rows.not_finite > 0 {
            lines.push(format!(
                "Note: {} of {} galaxies of {name} have no ellipticity and count as missing.",
                rows.not_finite,
                rows.not_finite + rows.used
            ));
        }
    }
    lines
}

/// Figures per set, with a row of means where there are several sets.
pub fn per_set(scored: &[ScoredSet], title: &str, definition: Definition, choice: Choice) -> Table {
    let mut headings = vec![
        Heading::new("set", "Set"),
        Heading::new("kind", "Kind"),
        Heading::new("images", "Images"),
    ];
    headings.extend(COLUMNS.iter().map(|&(key, label, _, _, detail)| Heading {
        detail,
        ..Heading::new(key, label)
    }));
    headings.push(Heading::new("convention", "Conv."));
    headings.push(Heading::new("q_leaderboard", "Q leaderboard"));
    let mut rows = Vec::new();
    for ScoredSet { set, score, .. } in scored {
        let mut row = vec![
            Cell::text(if *set == 0 {
                "–".into()
            } else {
                format!("{set:02}")
            }),
            Cell::text(kind_label(*set)),
            Cell::number(score.images as f64, 0),
        ];
        row.extend(figure_cells(&score.figures, score.errors().as_ref()));
        row.push(Cell::text(score.chosen.number().to_string()));
        row.push(Cell::number(
            score.conventions[score.best.index()].quality.q,
            2,
        ));
        rows.push(row);
    }
    if scored.len() > 1 {
        let (mean, errors) = means(scored);
        let mut row = vec![
            Cell::text("mean"),
            Cell::Empty,
            Cell::number(scored.iter().map(|s| s.score.images as f64).sum(), 0),
        ];
        row.extend(figure_cells(&mean, errors.as_ref()));
        row.push(Cell::Empty);
        let best = scored
            .iter()
            .map(|s| s.score.conventions[s.score.best.index()].quality.q)
            .sum::<f64>();
        row.push(Cell::number(best / scored.len() as f64, 2));
        rows.push(row);
    }
    let mut notes = vec![definition_note(definition, choice)];
    notes.extend(warnings(scored));
    Table {
        title: title.to_owned(),
        headings,
        rows,
        notes,
    }
}

/// Figures of power-spectrum submissions, one row per set and one of means. There are no errors: a
/// spectrum does not say how its images scatter.
pub fn spectra(
    scored: &[(u32, (Quality, BiasFits))],
    title: &str,
    definition: Definition,
) -> Table {
    let headings = vec![
        Heading::new("set", "Set"),
        Heading::new("kind", "Kind"),
        Heading::new("q", "Q"),
        Heading::new("sigma_sys", "σ_sys×10⁴"),
        Heading::new("m_half", "M/2"),
        Heading::new("sqrt_a", "√A×10⁴"),
    ];
    let mut rows: Vec<Vec<Cell>> = scored
        .iter()
        .map(|(set, (quality, fit))| {
            let label = if *set == 0 {
                "–".into()
            } else {
                format!("{set:02}")
            };
            vec![
                Cell::text(label),
                Cell::text(kind_label(*set)),
                Cell::number(quality.q, 2),
                Cell::number(quality.sigma_sys * 1e4, 4),
                Cell::number(fit.cl.m, 4),
                Cell::number(fit.cl.sqrtA * 1e4, 4),
            ]
        })
        .collect();
    if scored.len() > 1 {
        let mean = |value: fn(&(Quality, BiasFits)) -> f64| {
            scored.iter().map(|(_, s)| value(s)).sum::<f64>() / scored.len() as f64
        };
        rows.push(vec![
            Cell::text("mean"),
            Cell::Empty,
            Cell::number(mean(|s| s.0.q), 2),
            Cell::number(mean(|s| s.0.sigma_sys * 1e4), 4),
            Cell::number(mean(|s| s.1.cl.m), 4),
            Cell::number(mean(|s| s.1.cl.sqrtA * 1e4), 4),
        ]);
    }
    let definition = match definition {
        Definition::Leaderboard => "leaderboard",
        Definition::Corrected => "corrected",
    };
    Table {
        title: title.to_owned(),
        headings,
        rows,
        notes: vec![format!(
            "Figures: {definition} definition. √A in 10⁻⁴ for C_ℓ in steradian."
        )],
    }
}

/// True and measured bandpowers of every set.
pub fn bandpowers(scored: &[ScoredSet]) -> Table {
    let power = |value: f64| Cell::number(value * 1e6, 4);
    let mut rows = Vec::new();
    for ScoredSet { set, score, .. } in scored {
        let measured = score.spectra();
        for b in SCORED {
            rows.push(vec![
                Cell::number(f64::from(*set), 0),
                Cell::number(b as f64 + 1.0, 0),
                Cell::number(score.bins.l[b], 1),
                power(score.true_ee[b]),
                power(measured.ee[b]),
                power(measured.bb[b]),
                power(measured.eb[b]),
            ]);
        }
    }
    let headings = [
        ("set", "Set"),
        ("bin", "Bin"),
        ("l", "ℓ"),
        ("true_ee", "true EE×10⁶"),
        ("ee", "EE×10⁶"),
        ("bb", "BB×10⁶"),
        ("eb", "EB×10⁶"),
    ];
    Table {
        title: "Shear bandpowers ℓ²C_ℓ/2π of the scored bins".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows,
        notes: Vec::new(),
    }
}

fn bias_json(bias: &Bias) -> Value {
    json!({ "M": bias.M, "A": bias.A, "sqrtA": bias.sqrtA, "m": bias.m })
}

fn fits_json(fits: &BiasFits) -> Value {
    json!({
        "l2": bias_json(&fits.l2),
        "mode": bias_json(&fits.mode),
        "cl": bias_json(&fits.cl),
        "cl_over_2pi": bias_json(&fits.cl_over_2pi),
    })
}

fn class_json(score: &SetScore, representative: &ConventionScore, class: ConventionClass) -> Value {
    let mut object = json!({
        "EE": representative.ee,
        "BB": representative.bb,
        "EB": representative.eb,
        "sigma_sys": representative.quality.sigma_sys,
        "Q": representative.quality.q,
        "corr": score.class_correlation(class),
        "M": representative.fit.cl.M,
        "A": representative.fit.cl.A,
        "sqrtA": representative.fit.cl.sqrtA,
        "fit": fits_json(&representative.fit),
    });
    if let (Some(quality), Some(fit)) = (&representative.quality_dn, &representative.fit_dn) {
        object["sigma_sys_dn"] = json!(quality.sigma_sys);
        object["Q_dn"] = json!(quality.q);
        object["fit_dn"] = fits_json(fit);
    }
    object
}

/// What one set's JSON says about its input.
pub struct SetInput {
    /// Name of the case.
    pub case: String,
    /// Truth file as given.
    pub truth: String,
    /// Catalogues as given.
    pub catalogues: Vec<String>,
    /// Bandpower definition.
    pub definition: Definition,
}

/// Everything about one set scored from plain files, under the names that the public scoring cases
/// use, with errors and null tests added.
pub fn one_set_json(scored: &ScoredSet, input: &SetInput) -> Value {
    let score = &scored.score;
    let best = &score.conventions[score.best.index()];
    let matched = &score.conventions[score.matched.index()];
    let bins = &score.bins;
    let per_convention: BTreeMap<String, f64> = score
        .conventions
        .iter()
        .map(|c| (c.convention.number().to_string(), c.quality.q))
        .collect();
    let weights: Vec<f64> = (0..BINS).map(|b| bins.mode_weight(b)).collect();
    let errors = score.errors();
    json!({
        "case": input.case,
        "description": format!(
            "{} catalogue(s) scored by shearq {}",
            input.catalogues.len(),
            crate::VERSION
        ),
        "definition": input.definition,
        "files": { "truth": input.truth, "catalogues": input.catalogues },
        "n": score.grid.n,
        "size_deg": score.grid.field.0,
        "postage": score.grid.stamp.0,
        "n_images": score.images,
        "noise_var": score.noise_variance,
        "l_min": score.grid.l_min().0,
        "l_max": score.grid.l_max().0,
        "dlogl": bins.width,
        "n_modes": bins.modes,
        "sum_l": bins.sum_l,
        "W": weights,
        "ll": bins.l,
        "dll": bins.dln_l,
        "P_noise": score.noise,
        "truth": { "EE": score.true_ee, "BB": score.true_bb },
        "submission": { "EE": best.ee, "BB": best.bb },
        "Q": best.quality.q,
        "sigma_sys": best.quality.sigma_sys,
        "winner": score.best.number(),
        "winner_class": score.best.class(),
        "matched": score.matched.number(),
        "matched_class": score.matched.class(),
        "corr_matched": matched.correlation,
        "Q_matched": matched.quality.q,
        "M": best.fit.cl.M,
        "A": best.fit.cl.A,
        "sqrtA": best.fit.cl.sqrtA,
        "Q_dn": best.quality_dn.map(|q| q.q),
        "sigma_sys_dn": best.quality_dn.map(|q| q.sigma_sys),
        "Q_per_convention": per_convention,
        "classes": {
            "A": class_json(score, &score.conventions[5], ConventionClass::A),
            "B": class_json(score, &score.conventions[4], ConventionClass::B),
        },
        "chosen": score.chosen.number(),
        "figures": score.figures,
        "figure_errors": errors,
        "error_method": format!("delete-one jackknife over up to {MAX_GROUPS} groups of images"),
        "rows": scored.rows,
        "warnings": warnings(std::slice::from_ref(scored)),
    })
}
