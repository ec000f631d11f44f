//! Legends: what the colours and line styles mean, in rows above the plot.

use super::colour::{INK, Rgb};
use super::scene::{Anchor, Scene, text_width};
use super::style::Style;
use super::{LABEL_SIZE, MARGIN};

/// The width of the sample line or box.
const SAMPLE: f64 = 24.0;
const GAP: f64 = 6.0;
const ROW: f64 = 18.0;

/// What a sample shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Sample {
    Curve(Style),
    Box,
}

/// One entry of a legend.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Entry {
    pub label: String,
    pub colour: Rgb,
    pub sample: Sample,
}

/// Entries broken into rows.
pub(super) struct Legend<'a> {
    rows: Vec<Vec<&'a Entry>>,
}

impl<'a> Legend<'a> {
    /// The entries that have a label, in as many rows as `width` asks for.
    pub(super) fn new(entries: &'a [Entry], width: f64) -> Self {
        let mut rows: Vec<Vec<&Entry>> = Vec::new();
        let mut used = f64::INFINITY;
        for entry in entries.iter().filter(|entry| !entry.label.is_empty()) {
            let needed = entry_width(entry) + 1.5 * MARGIN;
            if used + needed > width + 1.5 * MARGIN {
                rows.push(Vec::new());
                used = 0.0;
            }
            used += needed;
            if let Some(row) = rows.last_mut() {
                row.push(entry);
            }
        }
        Self { rows }
    }

    /// The height of all rows.
    pub(super) fn height(&self) -> f64 {
        self.rows.len() as f64 * ROW
    }

    /// Draws it from `top`, each row centred at `middle`.
    pub(super) fn draw(&self, scene: &mut Scene, middle: f64, top: f64) {
        for (number, row) in self.rows.iter().enumerate() {
            let gaps = 1.5 * MARGIN * (row.len().saturating_sub(1)) as f64;
            let width = row.iter().map(|entry| entry_width(entry)).sum::<f64>() + gaps;
            let mut x = middle - 0.5 * width;
            let y = top + (number as f64 + 0.5) * ROW;
            for entry in row {
                draw_sample(scene, entry, (x, y));
                let baseline = (x + SAMPLE + GAP, y + 0.36 * LABEL_SIZE);
                scene.text(&entry.label, baseline, LABEL_SIZE, INK, Anchor::Start);
                x += entry_width(entry) + 1.5 * MARGIN;
            }
        }
    }
}

fn entry_width(entry: &Entry) -> f64 {
    SAMPLE + GAP + text_width(&entry.label, LABEL_SIZE)
}

fn draw_sample(scene: &mut Scene, entry: &Entry, (x, y): (f64, f64)) {
    let line = [(x, y), (x + SAMPLE, y)];
    match entry.sample {
        Sample::Curve(Style::Line) => scene.path(line.to_vec(), entry.colour, 1.8),
        // Cut after a whole number of dashes.
        Sample::Curve(Style::Dashed) => {
            scene.dashes(&[(x, y), (x + SAMPLE - 1.0, y)], entry.colour, 1.8);
        }
        Sample::Curve(Style::Points) => scene.disc((x + 0.5 * SAMPLE, y), 3.2, entry.colour),
        Sample::Box => {
            scene.rectangle((x + 8.0, y - 6.0), (x + SAMPLE, y + 6.0), entry.colour);
        }
    }
}
