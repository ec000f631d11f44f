//! Reports of scores and of comparisons as one HTML page.

use std::path::Path;

use crate::score::ScoredSet;
use crate::views::spectrum;
use shearq_render::figure::{
    BarGroup, BarPlot, FigureError, HeatMap, LinePlot, PanelGrid, PictureFormat, Series, Style,
};
use shearq_render::html::{Block, Picture, Report, Section};
use shearq_render::table::{Cell, Table};

/// Scores of one submission, with its spectra beside the true ones.
///
/// # Errors
/// Those of [`Picture::draw`].
pub fn scores(name: &str, scored: &[ScoredSet], table: Table) -> Result<Section, FigureError> {
    let mut blocks = vec![Block::Table(table)];
    let with_power: Vec<&ScoredSet> = scored
        .iter()
        .filter(|set| set.score.constant.is_none())
        .collect();
    if !with_power.is_empty() {
        blocks.push(Block::Figure(
            Picture::draw(
                &spectra(name, &with_power),
                PictureFormat::Svg,
                format!("spectra-{name}"),
                "E-mode bandpowers of the scored bins: true, measured with the noise that the images leave, which Q counts, and less that noise, which Q_dn has. Those run below the truth where shear is lost, and are left out where they are below zero.",
            )?,
        ));
    }
    Ok(Section::new(name, format!("Scores of {name}"), blocks))
}

/// Submissions side by side.
///
/// # Errors
/// Those of [`Picture::draw`].
pub fn comparison(table: Table, map: &HeatMap) -> Result<Section, FigureError> {
    let mut blocks = Vec::new();
    for (key, caption) in [
        (
            "q_calibrated",
            "Quality after dividing by the measured response: noise and biases that depend on scale decide.",
        ),
        (
            "m_cross",
            "Multiplicative bias: 0 for a method that keeps the shear.",
        ),
    ] {
        if let Some(bars) = bars(&table, key) {
            blocks.push(Block::Figure(Picture::draw(
                &bars,
                PictureFormat::Svg,
                key,
                caption,
            )?));
        }
    }
    let caption = "Q of each set in the convention of the table, and the mean.";
    blocks.push(Block::Figure(Picture::draw(
        map,
        PictureFormat::Svg,
        "q-per-set",
        caption,
    )?));
    blocks.insert(0, Block::Table(table));
    Ok(Section::new("comparison", "Comparison", blocks))
}

/// A page of such sections; `settings` are what made it.
///
/// # Errors
/// Where it cannot be written.
pub fn save(
    path: &Path,
    title: &str,
    sections: Vec<Section>,
    settings: Vec<(String, String)>,
) -> Result<(), shearq_files::FileError> {
    let mut made_by = vec![(
        "Version".to_owned(),
        format!("shearq {}", shearq_pipeline::VERSION),
    )];
    made_by.extend(settings);
    Report {
        title: title.into(),
        subtitle: String::new(),
        sections,
        settings: made_by,
    }
    .save(path)
}

fn spectra(name: &str, scored: &[&ScoredSet]) -> PanelGrid {
    let plot = |set: &&ScoredSet| {
        let score = &set.score;
        let powers = [
            &score.bins.l,
            &score.true_ee,
            &score.spectra().ee,
            &score.ee_error,
        ];
        spectrum::panel(set.set, set.kind, powers, score.noise.as_ref())
    };
    PanelGrid {
        title: format!("Shear power of {name}"),
        columns: 3,
        plots: scored.iter().map(plot).collect(),
    }
}

/// Bands of what surveys to come ask of shear, in the units of the table of [`contest`]: |m| of two in a thousand.
const BAND: f64 = 2.0;
/// Colour of what is to be reached.
const AIM: usize = 6;
/// Largest m in a picture that has smaller ones too.
const SEEN: f64 = 20.0;

/// Submissions held against each other on every kind of set: scatter over its bound, biases and Q, each beside
/// what is to be reached. `table` is that of a study, one row a set and submission.
pub fn contest(table: &Table) -> PanelGrid {
    let text = |row: &[Cell], key: &str| match table.place(key).and_then(|k| row.get(k)) {
        Some(Cell::Text(words)) => words.clone(),
        _ => String::new(),
    };
    let number = |row: &[Cell], key: &str| match table.place(key).and_then(|k| row.get(k)) {
        Some(&Cell::Number { value, error, .. }) => (value, error.unwrap_or(f64::NAN)),
        _ => (f64::NAN, f64::NAN),
    };
    // Rows of means have no number of a set.
    let rows: Vec<(f64, &[Cell])> = table
        .rows
        .iter()
        .filter_map(|row| Some((text(row, "set").parse().ok()?, row.as_slice())))
        .collect();
    let mut names: Vec<String> = Vec::new();
    for (_, row) in &rows {
        let name = text(row, "submission");
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let ends = || {
        let sets = || rows.iter().map(|(set, _)| *set);
        let (least, most) = (
            sets().fold(f64::INFINITY, f64::min),
            sets().fold(f64::NEG_INFINITY, f64::max),
        );
        vec![least - 0.5, most + 0.5]
    };
    let plot = |key: &str, label: &str, of_levels: &str, levels: &[f64]| {
        let level = |(k, &value): (usize, &f64)| {
            let name = if k == 0 { of_levels } else { "" };
            Series::new(name, ends(), vec![value; 2], Style::Dashed, AIM)
        };
        let mut series: Vec<Series> = levels.iter().enumerate().map(level).collect();
        for (k, name) in names.iter().enumerate() {
            // Beside each other, for all of them to be seen.
            let aside = (k as f64 - (names.len() as f64 - 1.0) / 2.0) * 0.2;
            let own = || {
                rows.iter()
                    .filter(|(_, row)| text(row, "submission") == *name)
            };
            let (y, errors) = own().map(|(_, row)| number(row, key)).unzip();
            let x = own().map(|(set, _)| set + aside).collect();
            series.push(Series::new(name, x, y, Style::Points, k).with_errors(errors));
        }
        LinePlot {
            title: label.into(),
            x_label: "set".into(),
            x_whole: true,
            y_label: label.into(),
            series,
            ..LinePlot::default()
        }
    };
    // Uncalibrated submissions would leave nothing to be seen of the others: they are beyond the picture.
    let near = |key: &str, label: &str| {
        let plot = plot(key, label, &format!("± {BAND}"), &[-BAND, BAND]);
        let beyond: Vec<bool> = rows
            .iter()
            .map(|(_, row)| number(row, key).0.abs() > SEEN)
            .collect();
        if !(beyond.contains(&true) && beyond.contains(&false)) {
            return plot;
        }
        LinePlot {
            title: format!("{label}, beyond ± {SEEN} left out"),
            y_range: Some((-SEEN, SEEN)),
            ..plot
        }
    };
    let mut q = plot("q_spectrum", "Q of cross-spectra", "", &[]);
    let limit = rows
        .iter()
        .map(|(_, row)| number(row, "q_limit").0)
        .collect();
    let sets = rows.iter().map(|(set, _)| *set).collect();
    q.series.insert(
        0,
        Series::new("limit of Q", sets, limit, Style::Points, AIM),
    );
    PanelGrid {
        title: "Submissions against each other and what can be reached".into(),
        columns: 2,
        plots: vec![
            plot(
                "scatter_over_bound",
                "scatter / bound",
                "Cramér–Rao bound",
                &[1.0],
            ),
            near("m1", "m1×10³"),
            near("m2", "m2×10³"),
            plot("c1", "c1×10⁴", "", &[0.0]),
            plot("leakage", "PSF leakage", "", &[0.0]),
            q,
        ],
    }
}

/// A column of the table as bars, one a row; `None` where no row has a value.
fn bars(table: &Table, key: &str) -> Option<BarPlot> {
    let k = table.place(key)?;
    let mut bars = BarGroup::default();
    let (mut names, mut errors) = (Vec::new(), Vec::new());
    for row in &table.rows {
        if let (Cell::Text(name), Cell::Number { value, error, .. }) = (row.first()?, row.get(k)?)
            && value.is_finite()
        {
            names.push(name.clone());
            bars.values.push(*value);
            errors.push(error.unwrap_or(f64::NAN));
        }
    }
    bars.errors = Some(errors);
    (!names.is_empty()).then(|| BarPlot {
        title: table.headings[k].label.clone(),
        x_label: String::new(),
        y_label: table.headings[k].label.clone(),
        categories: names,
        groups: vec![bars],
    })
}
