//! A report, and a folder with the pictures and data of its exhibits.

use std::path::Path;

use shearq_files::{FileError, atomic};
use thiserror::Error;

use crate::figure::{Figure, FigureError};
use crate::html::{Block, Picture, Report, Section};
use crate::table::{Table, TableFormat};

#[derive(Debug, Error)]
pub enum PageError {
    #[error(transparent)]
    Figure(#[from] FigureError),
    #[error(transparent)]
    File(#[from] FileError),
}

/// The report on its way. Figures and data are written at once, so that a stopped command leaves those that are done.
#[derive(Debug)]
pub struct Page<'a> {
    out: &'a Path,
    report: Report,
}

impl<'a> Page<'a> {
    /// An empty report to be written to `out`, with the settings that made it at its end.
    pub fn new(
        out: &'a Path,
        title: &str,
        subtitle: &str,
        settings: Vec<(String, String)>,
    ) -> Self {
        Page {
            out,
            report: Report {
                title: title.into(),
                subtitle: subtitle.into(),
                settings,
                ..Report::default()
            },
        }
    }

    /// Begins a section with a paragraph; a bracket at the end of the heading stays out of its link.
    pub fn section(&mut self, heading: &str, text: &str) {
        let id = heading.split(" (").next().unwrap_or(heading);
        let section = Section::new(id, heading, vec![Block::Text(text.to_owned())]);
        self.report.sections.push(section);
    }

    fn add(&mut self, block: Block) {
        if let Some(section) = self.report.sections.last_mut() {
            section.push(block);
        }
    }

    /// Draws a figure as PNG and SVG and shows it.
    pub fn figure(
        &mut self,
        name: &str,
        figure: &impl Figure,
        caption: &str,
    ) -> Result<(), PageError> {
        // PNG for slides, SVG for papers.
        for ending in ["png", "svg"] {
            figure.save(self.out.join(format!("figures/{name}.{ending}")))?;
        }
        self.add(Block::Figure(Picture::draw(figure, name, caption)?));
        Ok(())
    }

    /// Writes a table's data and shows it.
    pub fn table(&mut self, name: &str, exhibit: &Table) -> Result<(), PageError> {
        self.data(name, exhibit)?;
        self.add(Block::Table(exhibit.clone()));
        Ok(())
    }

    /// Writes a table's data into the folder of the report.
    pub fn data(&self, name: &str, exhibit: &Table) -> Result<(), PageError> {
        let text = exhibit.render(TableFormat::Csv);
        let path = self.out.join(format!("data/{name}.csv"));
        Ok(atomic::write(path, text.as_bytes())?)
    }

    /// Writes the report.
    pub fn save(self) -> Result<(), PageError> {
        Ok(self.report.save(self.out.join("report.html"))?)
    }
}
