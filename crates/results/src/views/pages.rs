//! HTML pages of scores and comparisons, and their figures.

use std::path::Path;

use crate::score::ScoredSet;
use shearq_bias::QUANTITIES;
use shearq_measure::Steps;
use shearq_render::figure::{
    ColourMap, FigureError, ImageGrid, ImagePanel, ImageRow, LinePlot, PanelGrid, Series, Stretch,
    Style,
};
use shearq_render::html::{Block, Picture, Report, Section};
use shearq_render::table::{Cell, Table};
use shearq_scoring::{BINS, Metrics, SCORED};
use shearq_simulate::kinds::SetKind;

pub fn scores(name: &str, scored: &[ScoredSet], table: Table) -> Result<Section, FigureError> {
    let mut blocks = vec![Block::Table(table)];
    blocks.extend(spectra(name, scored)?);
    Ok(Section::new(name, format!("Scores of {name}"), blocks))
}

/// True and measured bandpowers of each set with a shear field, if there is one.
pub fn spectra(name: &str, scored: &[ScoredSet]) -> Result<Option<Block>, FigureError> {
    let with_power = scored.iter().filter(|set| set.score.constant.is_none());
    let panel = |set: &ScoredSet| {
        let score = &set.score;
        let powers = [
            &score.bins.l,
            &score.true_ee,
            &score.spectra().ee,
            &score.ee_error,
        ];
        spectrum_panel(
            set.number(),
            set.record.kind(),
            powers,
            score.noise.as_ref(),
        )
    };
    let plots: Vec<LinePlot> = with_power.map(panel).collect();
    if plots.is_empty() {
        return Ok(None);
    }
    let grid = PanelGrid {
        title: format!("Shear power of {name}"),
        columns: 2,
        plots,
    };
    let caption = "E-mode bandpowers of the scored bins. Q uses the measured bandpowers with their noise, Q_dn without. Without noise they are below the truth if shear is lost. Negative values are not plotted.";
    let picture = Picture::draw(&grid, format!("spectra-{name}"), caption)?;
    Ok(Some(Block::Figure(picture)))
}

pub fn comparison(
    table: Table,
    verdict: Option<String>,
    per_set: &PanelGrid,
) -> Result<Section, FigureError> {
    let mut blocks = Vec::new();
    if let Some(verdict) = verdict {
        blocks.push(Block::Text(verdict));
        if let Some(first) = table.headings.first() {
            let keys = [
                first.key,
                "m_cross",
                "galaxy_noise",
                "q_calibrated",
                "q_calibrated_difference",
                "q_calibrated_sigma",
            ];
            let there = |key: &&str| table.place(key).is_some();
            let keys: Vec<&str> = keys.into_iter().filter(there).collect();
            blocks.push(Block::Table(table.part(&keys, "Verdict", &[])));
        }
    }
    let means = ["q_calibrated", "m_cross"].map(|key| metric_plot(&table, key));
    let means = PanelGrid {
        columns: 2,
        plots: means.into_iter().flatten().collect(),
        ..PanelGrid::default()
    };
    // Of one set, the next figure is the same.
    let several = per_set.plots.iter().any(|plot| plot.x_names.len() > 1);
    if several && !means.plots.is_empty() {
        let caption = "Means over the sets. Calibrated Q is the quality after dividing by the measured response: noise and scale-dependent biases determine it. m is the multiplicative bias, 0 for an unbiased method.";
        blocks.push(Block::Figure(Picture::draw(&means, "means", caption)?));
    }
    let caption = "Q, calibrated Q and m of each set, in the convention of the table.";
    let picture = Picture::draw(per_set, "per-set", caption)?;
    blocks.extend([Block::Figure(picture), Block::Folded(table)]);
    Ok(Section::new("comparison", "Comparison", blocks))
}

pub fn save(
    path: &Path,
    title: &str,
    sections: Vec<Section>,
    settings: Vec<(String, String)>,
) -> Result<(), shearq_files::FileError> {
    let mut made_by = vec![(
        "Version".to_owned(),
        format!("shearq {}", shearq_dataset::VERSION),
    )];
    made_by.extend(settings);
    Report {
        title: title.into(),
        subtitle: String::new(),
        sections,
        glossary: glossary(),
        settings: made_by,
    }
    .save(path)
}

fn glossary() -> Vec<(String, String)> {
    let metrics = Metrics::ALL.map(|metric| (metric.name, metric.meaning));
    let estimates = QUANTITIES.map(|quantity| (quantity.key, quantity.meaning));
    let others = [
        ("configuration", "The settings of a method, by name."),
        ("submission", "The settings of a method, by name."),
        ("set", "The number of a set of images."),
        (
            "kind",
            "What distinguishes the galaxies or the PSF of a set.",
        ),
        ("images", "Images of a set."),
        ("galaxies", "Galaxies without a flag."),
        ("n", "Galaxies without a flag."),
        (
            "n_effective",
            "(Σw)²/Σw²: as many galaxies of equal weight have the same information.",
        ),
        (
            "units",
            "Independent units, from which errors are determined.",
        ),
        ("bin", "Range of the binned quantity."),
        (
            "q_difference",
            "Difference of Q from the first row on the same images.",
        ),
        ("sigma", "The same, divided by its error."),
        (
            "q_calibrated_difference",
            "Difference of calibrated Q from the first row on the same images.",
        ),
        ("q_calibrated_sigma", "The same, divided by its error."),
        (
            "convention",
            "Convention of signs and axes in which the ellipticities were scored.",
        ),
    ];
    let mut all: Vec<(String, String)> = Vec::new();
    for (key, meaning) in metrics.into_iter().chain(others).chain(estimates) {
        if !all.iter().any(|(known, _)| known == key) {
            all.push((key.to_owned(), meaning.to_owned()));
        }
    }
    all
}

// Share of the highest power below which true power is rounding.
const ROUNDING: f64 = 1e-12;

/// E-mode bandpowers of a set: (multipoles, truth, measured, standard errors).
pub type Powers<'a> = [&'a [f64; BINS]; 4];

/// The scored bins with modes, which have a multipole `l`. Small grids lack some.
pub fn bins(l: &[f64; BINS]) -> impl Iterator<Item = usize> {
    SCORED.filter(|&bin| l[bin] > 0.0)
}

/// The scored bandpowers of the true and the measured shear, and the measured ones without noise, if it is known.
pub fn spectrum_panel(
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

/// One galaxy: stamp, PSF, deconvolved stamp, residual, ACF, and the part of the ACF that is measured.
pub fn steps_row(label: &str, steps: Steps) -> ImageRow {
    use ColourMap::{Diverging, Viridis};
    let panel = |title: &str, image, map, stretch| ImagePanel {
        title: title.into(),
        image,
        map,
        stretch,
    };
    ImageRow {
        label: label.into(),
        panels: vec![
            panel("Stamp", steps.stamp, Viridis, Stretch::Linear),
            panel("PSF", steps.psf, Viridis, Stretch::Asinh),
            panel("Deconvolved", steps.deconvolved, Viridis, Stretch::Linear),
            panel("Residual", steps.residual, Diverging, Stretch::Linear),
            panel("ACF", steps.acf, Viridis, Stretch::Linear),
            panel("ACF used", steps.used, Viridis, Stretch::Linear),
        ],
    }
}

/// Several galaxies under a title, which ends with the version.
pub fn steps_figure(title: &str, rows: Vec<ImageRow>) -> ImageGrid {
    ImageGrid {
        title: format!("{title} (shearq {})", shearq_dataset::VERSION),
        rows,
    }
}

fn metric_plot(table: &Table, key: &str) -> Option<LinePlot> {
    let k = table.place(key)?;
    let (mut names, mut values, mut errors) = (Vec::new(), Vec::new(), Vec::new());
    for row in &table.rows {
        if let (Cell::Text(name), Cell::Number { value, error, .. }) = (row.first()?, row.get(k)?)
            && value.is_finite()
        {
            names.push(name.clone());
            values.push(*value);
            errors.push(error.unwrap_or(f64::NAN));
        }
    }
    let x = (0..names.len()).map(|row| row as f64).collect();
    let series = Series::new("", x, values, Style::Points, 0).with_errors(errors);
    (!names.is_empty()).then(|| LinePlot {
        y_label: table.headings[k].label.clone(),
        x_names: names,
        series: vec![series],
        ..LinePlot::default()
    })
}
