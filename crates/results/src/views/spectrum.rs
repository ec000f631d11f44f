//! Plot of the shear power spectrum of a set.

use shearq_scoring::{BINS, SCORED};

use shearq_render::figure::{LinePlot, Series, Style};
use shearq_simulate::kinds::SetKind;

// Share of the highest power below which true power is rounding.
const ROUNDING: f64 = 1e-12;

/// E-mode bandpowers of a set: (multipoles, truth, measured, standard errors).
pub type Powers<'a> = [&'a [f64; BINS]; 4];

/// The scored bins with modes, which have a multipole `l`. Small grids lack some.
pub fn bins(l: &[f64; BINS]) -> impl Iterator<Item = usize> {
    SCORED.filter(|&bin| l[bin] > 0.0)
}

/// The scored bandpowers of the true and the measured shear, and the measured ones without noise, if it is known.
pub fn panel(
    set: Option<u32>,
    kind: Option<SetKind>,
    [l, truth, measured, errors]: Powers<'_>,
    noise: Option<&[f64; BINS]>,
) -> LinePlot {
    // At the highest multipole, the truth of small grids is rounding only.
    let highest = truth[SCORED].iter().copied().fold(0.0, f64::max);
    let seen: Vec<usize> = bins(l)
        .filter(|&bin| truth[bin] > ROUNDING * highest)
        .collect();
    let scored = |values: &[f64; BINS]| seen.iter().map(|&bin| values[bin]).collect::<Vec<_>>();
    let title = set.map(|number| {
        let kind = kind.map_or("", |kind| kind.image.label());
        format!("Set {number} {kind}").trim_end().to_owned()
    });
    let mut series = vec![
        Series::new("true", scored(l), scored(truth), Style::Line, 2),
        Series::new("measured", scored(l), scored(measured), Style::Points, 5)
            .with_errors(scored(errors)),
    ];
    if let Some(noise) = noise {
        let rest = seen.iter().map(|&bin| measured[bin] - noise[bin]).collect();
        series.push(
            Series::new("minus its noise", scored(l), rest, Style::Points, 0)
                .with_errors(scored(errors)),
        );
    }
    LinePlot {
        title: title.unwrap_or_default(),
        x_label: "ℓ".into(),
        y_label: "ℓ²C(ℓ)/2π".into(),
        x_log: true,
        y_log: true,
        series,
        ..LinePlot::default()
    }
}
