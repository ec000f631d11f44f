//! Arguments that several subcommands share.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};
use shearq_scoring::{Choice, Convention, Definition};

use crate::choices::named;
use crate::{print, print_table, tell};
use shearq_pipeline::data::pattern::MAX_SET;
use shearq_pipeline::images::{ImageId, Shard};
use shearq_render::figure::FigureError;
use shearq_render::html::Section;
use shearq_render::table::{Table, TableFormat};
use shearq_render::terminal::fitted;
use shearq_results::compare::Way;
use shearq_results::score::OWN;
use shearq_results::views::pages;
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::kinds::SETS;
use shearq_simulate::set::SimulationSettings;

/// A list of sets such as `1,2,7-9` or `all`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SetList(pub(super) Vec<u32>);

impl FromStr for SetList {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(SetList((1..=SETS).collect()));
        }
        let number = |part: &str| -> Result<u32, String> {
            match part.trim().parse() {
                Ok(set) if (1..=MAX_SET).contains(&set) => Ok(set),
                _ => Err(format!(
                    "`{part}` is not a set; expected numbers from 1 to {MAX_SET} as in `1,2,7-9`, or `all`"
                )),
            }
        };
        let mut sets = BTreeSet::new();
        for part in text.split(',') {
            match part.split_once('-') {
                Some((first, last)) => {
                    let (first, last) = (number(first)?, number(last)?);
                    if first > last {
                        return Err(format!("`{part}` runs backwards"));
                    }
                    sets.extend(first..=last);
                }
                None => {
                    sets.insert(number(part)?);
                }
            }
        }
        Ok(SetList(sets.into_iter().collect()))
    }
}

impl std::fmt::Display for SetList {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sets: Vec<String> = self.0.iter().map(u32::to_string).collect();
        f.write_str(&sets.join(","))
    }
}

impl SetList {
    /// The sets, if all of them can be simulated.
    pub(super) fn simulated(&self) -> anyhow::Result<&[u32]> {
        if let Some(set) = self.0.iter().find(|&&set| set > SETS) {
            anyhow::bail!("--sets: there is no set {set} to simulate; expected 1 to {SETS}");
        }
        Ok(&self.0)
    }
}

/// How to print a table that has columns of detail.
#[derive(Debug, Clone, Args)]
pub(super) struct Printing {
    #[command(flatten)]
    form: Form,
    /// Print the columns of detail (c, m per component, null tests) in the other formats too, and tables
    /// wider than the terminal.
    #[arg(long)]
    wide: bool,
    /// Print these metrics alone, beside the names of the rows and in this order: columns by their names in CSV, as
    /// `q,q_calibrated,m_cross`; a table that fits into a column of a paper.
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    metrics: Vec<String>,
}

impl Printing {
    pub(super) fn format(&self) -> TableFormat {
        self.form.format
    }

    /// Whether only some metrics are printed.
    pub(super) fn chooses(&self) -> bool {
        !self.metrics.is_empty()
    }

    /// The metrics that are asked for of a table.
    fn chosen(&self, table: &Table) -> anyhow::Result<Table> {
        table.chosen(&self.metrics).map_err(|unknown| {
            let known = table.metrics().join(", ");
            anyhow::anyhow!("--metrics: no metric is called {unknown:?}; expected some of {known}")
        })
    }

    /// Refuses metrics that such a table does not have, before anything is written.
    pub(super) fn check(&self, table: &Table) -> anyhow::Result<()> {
        self.chosen(table).map(|_| ())
    }

    /// Prints a table.
    ///
    /// # Errors
    /// Where a metric that is asked for is no column of it.
    pub(super) fn print(&self, table: &Table) -> anyhow::Result<()> {
        if self.chooses() {
            let chosen = self.chosen(table)?;
            return match (self.form.format, self.wide) {
                (TableFormat::Table, true) => print(&fitted(&chosen, None)),
                _ => self.form.print(&chosen),
            };
        }
        match (self.form.format, self.wide) {
            (TableFormat::Table, true) => print(&fitted(table, None)),
            (TableFormat::Table, false) => {
                let mut narrow = table.narrow();
                let details = table.headings.iter().filter(|heading| heading.detail);
                let details: Vec<&str> = details.map(|heading| heading.label.as_str()).collect();
                if !details.is_empty() {
                    let note = format!("More with --wide: {}", details.join(", "));
                    narrow.notes.push(note);
                }
                self.form.print(&narrow)
            }
            (TableFormat::Markdown | TableFormat::Latex, false) => self.form.print(&table.narrow()),
            _ => self.form.print(table),
        }
    }
}

/// A page to be written.
#[derive(Debug, Clone, Args)]
pub(super) struct ReportFile {
    /// Write the results as one HTML page with metrics, which needs nothing else.
    #[arg(long = "report", value_name = "FILE")]
    path: Option<PathBuf>,
}

impl ReportFile {
    /// Whether a page was asked for.
    pub(super) fn is_wanted(&self) -> bool {
        self.path.is_some()
    }

    /// Writes the page, if one was asked for.
    pub(super) fn save(
        &self,
        title: &str,
        sections: impl FnOnce() -> Result<Vec<Section>, FigureError>,
        made_by: impl FnOnce() -> anyhow::Result<Vec<(String, String)>>,
    ) -> anyhow::Result<()> {
        if let Some(path) = &self.path {
            pages::save(path, title, sections()?, made_by()?)?;
        }
        Ok(())
    }
}

/// How to print a table.
#[derive(Debug, Clone, Args)]
pub(super) struct Form {
    /// How to print; `csv` and `json` have every column in full precision.
    #[arg(long, value_parser = named::<TableFormat>(), default_value = "table")]
    pub(super) format: TableFormat,
}

impl Form {
    /// Prints a table. CSV has no room for its notes, which go to standard error.
    pub(super) fn print(&self, table: &Table) -> anyhow::Result<()> {
        if self.format == TableFormat::Csv {
            for note in &table.notes {
                tell(format_args!("{note}"));
            }
        }
        match self.format {
            TableFormat::Table => print_table(table),
            format => print(&table.render(format)),
        }
    }
}

/// Galaxies a side of a simulated image, by default.
const GRID: u16 = 100;
/// Seed of a simulation, by default.
const SEED: u64 = 1;

/// What simulated data are made from.
#[derive(Debug, Clone, Args)]
pub(super) struct SimulationArguments {
    /// Galaxies a side of a simulated image.
    #[arg(long, value_name = "N", default_value_t = GRID, value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: u16,
    /// Seed of all random numbers of a simulation.
    #[arg(long, value_name = "SEED", default_value_t = SEED)]
    seed: u64,
    /// Factor on the simulated shear power spectrum.
    #[arg(
        long,
        value_name = "A",
        default_value_t = 1.0,
        allow_negative_numbers = true
    )]
    amplitude: f64,
    /// Extra slope of the simulated shear power spectrum, about ℓ = 1000.
    #[arg(
        long,
        value_name = "T",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    tilt: f64,
}

impl SimulationArguments {
    pub(super) fn settings(&self) -> anyhow::Result<SimulationSettings> {
        let &SimulationArguments {
            grid,
            seed,
            amplitude,
            tilt,
        } = self;
        let settings = SimulationSettings {
            spectrum: ShearSpectrum { amplitude, tilt },
            ..SimulationSettings::new(seed, usize::from(grid))
        };
        settings.validate()?;
        Ok(settings)
    }

    /// Refuses them where nothing is simulated.
    pub(super) fn must_be_unused(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            self.settings()? == SimulationSettings::new(SEED, usize::from(GRID)),
            "--grid, --seed, --amplitude and --tilt are for simulated data"
        );
        Ok(())
    }
}

/// Which part of the work to do.
#[derive(Debug, Clone, Args)]
pub(super) struct Sharding {
    /// Do only the K-th of N parts of equal numbers of images, as one of N processes that may write to
    /// the same folder at the same time; `merge` then checks that all is there (docs/clusters.md).
    #[arg(long, value_name = "K/N")]
    pub(super) shard: Option<Shard>,
}

impl Sharding {
    /// The images to work on, out of all.
    pub(super) fn part(&self, all: &[ImageId]) -> Vec<ImageId> {
        self.shard.unwrap_or(Shard::WHOLE).part(all)
    }
}

/// Number of worker threads.
#[derive(Debug, Clone, Args)]
pub(super) struct Threads {
    /// Worker threads [default: one per core]. Results do not depend on it.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

impl Threads {
    pub(super) fn number(&self) -> usize {
        self.threads.map_or_else(
            || std::thread::available_parallelism().map_or(1, usize::from),
            usize::from,
        )
    }
}

/// Bandpower definition on the command line.
#[derive(Debug, Clone, Copy, Default, ValueEnum)]
enum DefinitionArgument {
    /// The challenge's own arithmetic.
    #[default]
    Leaderboard,
    /// True azimuthal averages over fixed bins.
    Corrected,
}

/// How to score.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct ScoreSettings {
    /// How bandpowers and Q are defined.
    #[arg(long, value_enum, default_value_t)]
    definition: DefinitionArgument,
    /// Convention of the metrics: 1 to 8 (5 is the standard one), `matched` to the truth of all sets
    /// together, or `best` as the leaderboard took it, set by set [default: 5 for what shearq measured,
    /// matched for other catalogues].
    #[arg(long, value_name = "WHICH", value_parser = parse_choice)]
    convention: Option<Choice>,
}

impl ScoreSettings {
    pub(super) fn definition(&self) -> Definition {
        match self.definition {
            DefinitionArgument::Leaderboard => Definition::Leaderboard,
            DefinitionArgument::Corrected => Definition::Corrected,
        }
    }

    /// How variants are scored.
    pub(super) fn way(&self) -> Way {
        Way {
            definition: self.definition(),
            own: self.own_choice(),
            foreign: self.choice(),
        }
    }

    /// The convention asked for, or that of other programs' catalogues.
    pub(super) fn choice(&self) -> Choice {
        self.convention.unwrap_or(Choice::Matched)
    }

    /// The convention asked for, or that of our own measurements.
    pub(super) fn own_choice(&self) -> Choice {
        self.convention.unwrap_or(OWN)
    }
}

/// Refuses a submission that is named twice, which would be measured twice.
pub(super) fn given_once(submissions: &[String]) -> anyhow::Result<()> {
    for (k, name) in submissions.iter().enumerate() {
        anyhow::ensure!(
            !submissions[..k].contains(name),
            "--submission {name} is given twice"
        );
    }
    Ok(())
}

/// A positive number.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok();
    number
        .filter(|number: &f64| number.is_finite() && *number > 0.0)
        .ok_or_else(|| "expected a positive number".into())
}

fn parse_choice(text: &str) -> Result<Choice, String> {
    match text {
        "matched" => Ok(Choice::Matched),
        "best" => Ok(Choice::Best),
        number => number
            .parse()
            .ok()
            .and_then(|number: u8| Convention::try_from(number).ok())
            .map(Choice::Insist)
            .ok_or_else(|| "expected `matched`, `best` or a number from 1 to 8".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn set_lists_are_sorted_and_checked() {
        let parse = |text: &str| text.parse::<SetList>().map(|list| list.0);
        assert_eq!(parse("7-9,1,2,8"), Ok(vec![1, 2, 7, 8, 9]));
        assert_eq!(parse("all").unwrap().len(), 24);
        for wrong in ["", "0", "x", "3-1", "1,,2", "10000"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
