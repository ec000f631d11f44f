//! The leaderboard as a table, and as a page that works without server and network.

use std::path::Path;

use shearq_files::{FileError, atomic};
use shearq_render::figure::{Figure, FigureError, LinePlot, Series, Style};
use shearq_render::html::{Block, Picture, Report, Section};
use shearq_render::page::PageError;
use shearq_render::table::{Cell, Table, TableFormat};
use shearq_results::submit::manifest::Contents;
use shearq_results::views::comparison::q_heat_map;

use crate::constant::ConstantShears;
use crate::copies::NearCopy;
use crate::judge::{EntryInfo, Refused};
use crate::kind::RankBy;
use crate::ranking::{Board, Leaderboard, Standing, better, rounded};
use crate::readme;
use crate::terms::Challenge;

// The palette has eight colours.
const PLOTTED: usize = 6;

#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    pub challenge: &'a Challenge,
    pub board: &'a Leaderboard<'a>,
    pub refused: &'a [Refused],
    /// Mean Q of an entry of zeros; `None` for constant shears.
    pub zero_shear: Option<f64>,
    /// The true shears of sets with one shear each.
    pub constant: Option<&'a ConstantShears>,
    /// Entries that are nearly those of others.
    pub copies: &'a [NearCopy<'a>],
    /// Decimals of the metric. More of them reveal more of the true shear.
    pub digits: usize,
    /// Whether the metric of each set is shown.
    pub detail: bool,
}

// Name of the line of an entry without images. Teams may have this name, too, but they have a rank.
const ZERO_SHEAR: &str = "zero shear";

// Names of the columns of a metric and its error.
fn key(metric: RankBy) -> (&'static str, &'static str) {
    match metric {
        RankBy::Q => ("q", "q_error"),
        RankBy::QCorrected => ("q_corrected", "q_corrected_error"),
        RankBy::QCalibrated => ("q_calibrated", "q_calibrated_error"),
        RankBy::M => ("m", "m_error"),
        RankBy::C => ("c", "c_error"),
        RankBy::Qc => ("qc", "qc_error"),
        RankBy::Noise => ("noise", "noise_error"),
    }
}

// A line of a leaderboard.
enum Line<'a> {
    Standing(&'a Standing<'a>),
    /// An entry of zeros, with its metric.
    Zero(f64),
}

impl Line<'_> {
    // The cell of a standing; an entry of zeros has the words `zero`.
    fn cell(&self, zero: &str, cell: impl Fn(&Standing<'_>) -> Cell) -> Cell {
        match self {
            Line::Standing(standing) => cell(standing),
            Line::Zero(_) if zero.is_empty() => Cell::Empty,
            Line::Zero(_) => Cell::text(zero),
        }
    }
}

fn files(contents: Contents) -> &'static str {
    match contents {
        Contents::Catalogues => "catalogues",
        Contents::Spectra | Contents::CrossSpectra => "spectra",
    }
}

// The next larger number with so many decimals, so that no error becomes zero.
fn rounded_up(error: f64, digits: usize) -> f64 {
    let least = 0.5 * 10f64.powi(-(digits as i32));
    match error > 0.0 {
        true => rounded((error + least).max(2.0 * least), digits),
        false => error,
    }
}

// A number with the decimals that its error determines, at most `most`, and their number. More decimals would tell how an
// entry with one known mode follows the true shear: over 10 such modes, the correlation of |m| with the truth was
// 0.9999998. `None` without an error.
fn rounded_to_error(value: f64, error: f64, most: usize) -> Option<(f64, usize)> {
    let error = Some(error.abs()).filter(|error| error.is_normal())?;
    // Printing rounds 0.096 to 1e-1, so that it has one decimal.
    let exponent: i32 = format!("{error:.0e}").split_once('e')?.1.parse().ok()?;
    let step = 10f64.powi(exponent.max(0));
    let digits = usize::try_from(-exponent).unwrap_or(0).min(most);
    Some((rounded(value / step, digits) * step, digits))
}

fn received(info: &EntryInfo) -> String {
    info.received.strftime("%Y-%m-%d %H:%M").to_string()
}

fn title(info: &EntryInfo) -> String {
    match (info.reference, info.title.is_empty()) {
        (true, true) => "reference".into(),
        (true, false) => format!("reference: {}", info.title),
        (false, _) => info.title.clone(),
    }
}

// Shift of a team's points. First entries of equal quality would hide each other.
fn aside(team: usize, teams: usize) -> f64 {
    0.6 * ((team as f64 + 0.5) / teams as f64 - 0.5)
}

impl View<'_> {
    fn metric(&self) -> RankBy {
        self.challenge.rules.metric
    }

    /// All boards in one table: one row per team and reference.
    pub fn table(&self) -> Table {
        self.table_of(&[Board::Main, Board::Late, Board::Partial])
    }

    fn table_of(&self, boards: &[Board]) -> Table {
        let (metric, digits) = (self.metric(), self.digits);
        let standings = boards.iter().flat_map(|board| self.board.of(*board));
        let mut lines: Vec<Line<'_>> = standings.map(Line::Standing).collect();
        if boards.contains(&Board::Main) {
            let zero = metric.of_zero_shear(self.zero_shear.unwrap_or(f64::NAN));
            let behind = |line: &Line<'_>| match line {
                Line::Standing(standing) => {
                    standing.board != Board::Main || better(metric, zero, standing.best.value)
                }
                Line::Zero(_) => true,
            };
            let place = lines.iter().position(behind).unwrap_or(lines.len());
            lines.insert(place, Line::Zero(zero));
        }
        let mut table = Table::titled(format!("Leaderboard of {}", self.challenge.name));
        table.column("rank", "rank", &lines, |line| {
            let rank = |rank: usize| Cell::number(rank as f64, 0);
            line.cell("", |standing| standing.rank.map_or(Cell::Empty, rank))
        });
        table.column("team", "team", &lines, |line| {
            line.cell(ZERO_SHEAR, |standing| {
                Cell::text(&standing.best.info().team)
            })
        });
        table.column("method", "method", &lines, |line| {
            line.cell("no image", |standing| {
                Cell::text(&standing.best.info().method)
            })
        });
        table.column("title", "title", &lines, |line| {
            line.cell("reference: an entry of zeros", |standing| {
                Cell::text(title(standing.best.info()))
            })
        });
        table.column("files", "files", &lines, |line| {
            line.cell("", |standing| {
                Cell::text(files(standing.best.info().contents))
            })
        });
        // One cell would give the error two digits, and the value as many decimals.
        table.column(key(metric).0, metric.label(), &lines, |line| match line {
            Line::Standing(standing) => Cell::number(rounded(standing.best.value, digits), digits),
            Line::Zero(zero) => Cell::number(rounded(*zero, digits), digits),
        });
        table.column(key(metric).1, "± error", &lines, |line| {
            line.cell("", |standing| {
                Cell::number(rounded_up(standing.best.error, digits), digits)
            })
        });
        let suits = |other: &RankBy| *other != metric && other.suits(self.constant.is_some());
        let others = [RankBy::QCalibrated, RankBy::M, RankBy::C];
        for other in others.into_iter().filter(suits) {
            // No more decimals than the organiser's, where he chose fewer than the metric's.
            let fewer = metric.decimals().saturating_sub(digits);
            let most = other.decimals().saturating_sub(fewer);
            table.column(key(other).0, other.label(), &lines, |line| {
                line.cell("", |standing| {
                    let (value, error) = other.of(&standing.best.entry.sets, self.constant);
                    match rounded_to_error(value, error, most) {
                        Some((value, digits)) => Cell::number(value, digits),
                        None => Cell::Empty,
                    }
                })
            });
        }
        table.column("received", "received (UTC)", &lines, |line| {
            line.cell("", |standing| Cell::text(received(standing.best.info())))
        });
        table.column("entries", "entries", &lines, |line| {
            line.cell("", |standing| {
                Cell::number(standing.entries.len() as f64, 0)
            })
        });
        let filled =
            |board: &Board| *board != Board::Main && self.board.of(*board).next().is_some();
        if boards.iter().any(filled) {
            let all = self.challenge.data.sets.len();
            table.column("board", "board", &lines, |line| {
                line.cell("", |standing| {
                    Cell::text(match standing.board {
                        Board::Main => "main".to_owned(),
                        Board::Late => "late".to_owned(),
                        Board::Partial => {
                            format!("{} of {all} sets", standing.best.entry.sets.len())
                        }
                    })
                })
            });
        }
        table.notes = vec![
            metric.meaning().to_owned(),
            "Each team is ranked by its best entry. Teams share a rank if their difference is below its error or not printed.".into(),
        ];
        table.notes.extend(self.zero_note());
        table
    }

    // Entries that share files or shapes with an earlier one.
    fn copies(&self) -> Table {
        let name = |info: &EntryInfo| Cell::text(format!("{}: {}", info.team, info.method));
        let mut table = Table::titled("Near copies");
        table.column("entry", "entry", self.copies, |copy| name(copy.entry));
        table.column("earlier", "earlier entry", self.copies, |copy| {
            name(copy.earlier)
        });
        table.column("reason", "reason", self.copies, |copy| {
            Cell::text(copy.reason())
        });
        table
    }

    // Q of zero shear on boards of other metrics, too: whoever reads Q elsewhere must see it.
    fn zero_note(&self) -> Option<String> {
        let q = Cell::with_error(rounded(self.zero_shear?, 1), Some(f64::NAN), 2)
            .digits()?
            .0;
        let unknown = self.metric().of_zero_shear(1.0).is_nan();
        let why = match unknown {
            true => format!(
                " It has no {}, because it does not respond to the shear.",
                self.metric().label()
            ),
            false => String::new(),
        };
        Some(format!("Zero shear has Q = {q} without images.{why}"))
    }

    // Entries that were not scored or do not count.
    fn failures(&self) -> Table {
        let refused = self.refused.iter().map(|refused| {
            let name = refused.path.file_name().unwrap_or_default();
            let name = name.to_string_lossy().into_owned();
            (name, refused.team.as_str(), refused.reason.as_str())
        });
        let excluded = self.board.excluded.iter();
        let excluded = excluded
            .map(|(info, reason)| (info.method.clone(), info.team.as_str(), reason.as_str()));
        let rows: Vec<(String, &str, &str)> = refused.chain(excluded).collect();
        let mut table = Table::titled("Entries without a rank");
        table.column("entry", "entry", &rows, |row| Cell::text(&row.0));
        table.column("team", "team", &rows, |row| Cell::text(row.1));
        table.column("reason", "reason", &rows, |row| Cell::text(row.2));
        table
    }

    fn history(&self) -> LinePlot {
        let digits = self.digits;
        let metric = self.metric();
        let plotted: Vec<&Standing<'_>> = self
            .board
            .of(Board::Main)
            .filter(|standing| standing.rank.is_some())
            .take(PLOTTED)
            .collect();
        let most = plotted
            .iter()
            .flat_map(|s| &s.entries)
            .map(|e| e.number)
            .max();
        let last = most.unwrap_or(1) as f64;
        let mut series = Vec::new();
        for (colour, standing) in plotted.iter().enumerate() {
            let entries = &standing.entries;
            let aside = aside(colour, plotted.len());
            let x = entries.iter().map(|entry| entry.number as f64 + aside);
            let x: Vec<f64> = x.collect();
            let y: Vec<f64> = entries.iter().map(|e| rounded(e.value, digits)).collect();
            let errors = entries
                .iter()
                .map(|e| rounded_up(e.error, digits))
                .collect();
            let name = &standing.best.info().team;
            series.push(Series::new("", x.clone(), y.clone(), Style::Line, colour));
            series.push(Series::new(name, x, y, Style::Points, colour).with_errors(errors));
        }
        LinePlot {
            title: "Entries of the first teams".into(),
            x_label: "entry of the team".into(),
            x_whole: true,
            y_label: metric.label().into(),
            x_range: Some((0.5, last + 0.5)),
            series,
            ..LinePlot::default()
        }
    }

    fn report(&self) -> Result<Report, FigureError> {
        let mut blocks = vec![Block::Filtered(self.table_of(&[Board::Main]))];
        if !self.board.standings.is_empty() {
            let caption = format!(
                "{} of each entry, with its error, for the first {PLOTTED} teams at most.",
                self.metric().label()
            );
            let picture = Picture::draw(&self.history(), "entries", caption)?;
            blocks.push(Block::Figure(picture));
        }
        let mut sections = vec![Section::new("leaderboard", "Leaderboard", blocks)];
        if self.detail {
            sections.push(self.every_set()?);
        }
        let of_board = |board, title: &str| Table {
            title: title.into(),
            notes: Vec::new(),
            ..self.table_of(&[board])
        };
        for (id, table) in [
            ("late", of_board(Board::Late, "Late entries")),
            ("partial", of_board(Board::Partial, "Entries of some sets")),
            ("copies", self.copies()),
            ("failures", self.failures()),
        ] {
            if !table.rows.is_empty() {
                let title = table.title.clone();
                sections.push(Section::new(id, title, vec![Block::Filtered(table)]));
            }
        }
        let rules = Block::Text(readme::rules(self.challenge).join("\n\n"));
        sections.push(Section::new("rules", "Rules", vec![rules]));
        let Challenge {
            name,
            version,
            kind,
            data,
            rules,
            ..
        } = self.challenge;
        let about_data = format!(
            "{} sets of {} images with {2} × {2} galaxies",
            data.sets.len(),
            data.images,
            data.grid
        );
        let settings = [
            ("Version of the data", version.to_string()),
            ("Kind", kind.title.to_owned()),
            ("Data", about_data),
            ("Metric", rules.metric.label().to_owned()),
            ("Decimals", self.digits.to_string()),
            ("Program", format!("shearq {}", shearq_dataset::VERSION)),
        ];
        Ok(Report {
            title: name.clone(),
            subtitle: format!("{}: leaderboard", kind.title),
            sections,
            settings: settings
                .map(|(name, value)| (name.to_owned(), value))
                .into(),
            ..Report::default()
        })
    }

    fn every_set(&self) -> Result<Section, FigureError> {
        let rows: Vec<_> = self
            .board
            .standings
            .iter()
            .map(|standing| {
                let info = standing.best.info();
                let name = format!("{}: {}", info.team, info.method);
                (name, standing.best.entry.sets.as_slice())
            })
            .collect();
        let mut map = q_heat_map(&rows);
        map.row_label = "entry".into();
        map.decimals = map.decimals.min(self.digits);
        let caption =
            "Q of each set. Metrics of single sets reveal more of the true shear than their mean.";
        let picture = Picture::draw(&map as &dyn Figure, "q-per-set", caption)?;
        Ok(Section::new(
            "sets",
            "Metric of each set",
            vec![Block::Figure(picture)],
        ))
    }

    /// Writes the page to `path`, and the table as CSV and JSON with the same name.
    pub fn save(&self, path: &Path) -> Result<(), PageError> {
        let table = self.table();
        self.report()?.save(path)?;
        for (ending, format) in [("csv", TableFormat::Csv), ("json", TableFormat::Json)] {
            let beside = path.with_extension(ending);
            if beside == path {
                let message = "expected a name that ends in .html";
                return Err(FileError::new(path, message).into());
            }
            atomic::write(beside, table.render(format).as_bytes())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn six_teams_with_one_entry_are_six_points() {
        let places: Vec<f64> = (0..6).map(|team| aside(team, 6)).collect();
        assert!(places.windows(2).all(|pair| pair[1] - pair[0] > 0.09));
        assert!(places[0] > -0.5 && places[5] < 0.5 && aside(0, 1) == 0.0);
    }

    #[test]
    fn published_numbers_have_the_decimals_of_the_organiser() {
        assert_eq!(rounded(123.456, 1), 123.5);
        assert_eq!(rounded(123.456, 0), 123.0);
        // An error is rounded up and never to zero.
        assert_eq!(rounded_up(0.0004, 1), 0.1);
        assert_eq!(rounded_up(0.12, 1), 0.2);
        assert!(rounded_up(f64::NAN, 1).is_nan());
        // One digit of the error decides the last one of the value.
        assert_eq!(rounded_to_error(0.123456, 0.0234, 4), Some((0.12, 2)));
        assert_eq!(rounded_to_error(0.123456, 0.096, 4), Some((0.1, 1)));
        assert_eq!(rounded_to_error(0.123456, 0.00002, 4), Some((0.1235, 4)));
        assert_eq!(rounded_to_error(1234.56, 34.0, 1), Some((1230.0, 0)));
        assert_eq!(rounded_to_error(0.123456, f64::NAN, 4), None);
    }
}
