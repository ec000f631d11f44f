//! Reports of scores and of comparisons as one HTML page.

use std::path::Path;

use shearq_scoring::SCORED;

use super::figure::{
    BarGroup, BarPlot, FigureError, HeatMap, LinePlot, PanelGrid, PictureFormat, Series, Style,
};
use super::html::{Block, Picture, Report, Section};
use super::table::{Cell, Table};
use crate::results::score::ScoredSet;
use crate::simulate::kinds::SetKind;

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
                "True and measured E-mode bandpowers of the scored bins, noise included. Where the measured ones keep their distance at high ℓ, it is noise; where they run below, shear is lost.",
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
    let caption = "Q of each set as the leaderboard has it, and the mean.";
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
) -> Result<(), crate::io::FileError> {
    let mut made_by = vec![("Version".to_owned(), format!("shearq {}", crate::VERSION))];
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
        let of = |values: &[f64]| SCORED.map(|b| values[b]).collect::<Vec<f64>>();
        let kind = set.set.and_then(SetKind::of);
        let title = set.set.map(|number| {
            let kind = kind.map_or("", |kind| kind.image.label());
            format!("Set {number} {kind}")
        });
        let l = of(&score.bins.l);
        LinePlot {
            title: title.unwrap_or_default(),
            x_label: "ℓ".into(),
            y_label: "ℓ²C_ℓ/2π".into(),
            x_log: true,
            y_log: true,
            series: vec![
                Series::new("true", l.clone(), of(&score.true_ee), Style::Line, 2),
                Series::new("measured", l, of(&score.spectra().ee), Style::Points, 5),
            ],
            ..LinePlot::default()
        }
    };
    PanelGrid {
        title: format!("Shear power of {name}"),
        columns: 3,
        plots: scored.iter().map(plot).collect(),
    }
}

/// A column of the table as bars, one a row; `None` where no row has a value.
fn bars(table: &Table, key: &str) -> Option<BarPlot> {
    let k = table
        .headings
        .iter()
        .position(|heading| heading.key == key)?;
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
