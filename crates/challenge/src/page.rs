//! The leaderboard as a table, and as a page that works without server and network.

use std::path::Path;

use shearq_files::{FileError, atomic};
use shearq_render::figure::{Figure, FigureError, LinePlot, Series, Style};
use shearq_render::html::{Block, Picture, Report, Section};
use shearq_render::page::PageError;
use shearq_render::table::{Cell, Heading, Table, TableFormat};
use shearq_results::submit::manifest::Contents;
use shearq_results::views::comparison::q_heat_map;

use crate::constant::ConstantShears;
use crate::copies::NearCopy;
use crate::entry::EntryInfo;
use crate::judge::Refused;
use crate::kind::RankBy;
use crate::ranking::{Board, Leaderboard, Standing, better, rounded};
use crate::readme;
use crate::seal::Expected;
use crate::terms::Challenge;

/// Most teams in the plot of entries; the palette has eight colours, and the expected Q needs two.
const PLOTTED: usize = 6;
/// Colours of the expected Q of catalogues and spectra.
const EXPECTED_COLOURS: [usize; 2] = [6, 7];

/// How much of the scores is published.
#[derive(Debug, Clone, Copy)]
pub struct Disclosure {
    /// Decimals of the metric.
    pub digits: usize,
    /// Whether the metric of each set is shown.
    pub detail: bool,
}

/// What a leaderboard shows.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// The description of the challenge.
    pub challenge: &'a Challenge,
    /// The ranked teams.
    pub board: &'a Leaderboard<'a>,
    /// Entries that were not scored.
    pub refused: &'a [Refused],
    /// Mean Q of an entry of zeros; `None` for constant shears.
    pub zero_shear: Option<f64>,
    /// The true shears of sets with one shear each.
    pub constant: Option<&'a ConstantShears>,
    /// Entries that are nearly those of others.
    pub copies: &'a [NearCopy<'a>],
    /// Q that a perfect method can expect, if known.
    pub expected: Option<&'a Expected>,
    /// How much is published.
    pub disclosure: Disclosure,
}

/// Name of the line of an entry without images. Teams may have this name, too, but they have a rank.
const ZERO_SHEAR: &str = "zero shear";

/// Names of the columns of a metric and its error.
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

/// Kind of the files of an entry, in one word.
fn files(contents: Contents) -> &'static str {
    match contents {
        Contents::Catalogues => "catalogues",
        Contents::Spectra | Contents::CrossSpectra => "spectra",
    }
}

/// The next larger number with so many decimals, so that no error becomes zero.
fn rounded_up(error: f64, digits: usize) -> f64 {
    let least = 0.5 * 10f64.powi(-(digits as i32));
    match error > 0.0 {
        true => rounded((error + least).max(2.0 * least), digits),
        false => error,
    }
}

/// A number with the decimals that its error determines, at most `most`, and their number. More decimals would tell how an
/// entry with one known mode follows the true shear: over 10 such modes, the correlation of |m| with the truth was
/// 0.9999998. `None` without an error.
fn rounded_to_error(value: f64, error: f64, most: usize) -> Option<(f64, usize)> {
    let error = Some(error.abs()).filter(|error| error.is_normal())?;
    // Printing rounds 0.096 to 1e-1, so that it has one decimal.
    let exponent: i32 = format!("{error:.0e}").split_once('e')?.1.parse().ok()?;
    let step = 10f64.powi(exponent.max(0));
    let digits = usize::try_from(-exponent).unwrap_or(0).min(most);
    Some((rounded(value / step, digits) * step, digits))
}

/// Time of arrival of an entry, in UTC.
fn received(info: &EntryInfo) -> String {
    info.received.strftime("%Y-%m-%d %H:%M").to_string()
}

/// Title of an entry, with a mark for references.
fn title(info: &EntryInfo) -> String {
    match (info.reference, info.title.is_empty()) {
        (true, true) => "reference".into(),
        (true, false) => format!("reference: {}", info.title),
        (false, _) => info.title.clone(),
    }
}

/// Shift of a team's points. First entries of equal quality would hide each other.
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

    /// The standings of some boards.
    fn table_of(&self, boards: &[Board]) -> Table {
        let (metric, digits) = (self.metric(), self.disclosure.digits);
        let all = self.challenge.data.sets.len();
        let others: Vec<RankBy> = [RankBy::QCalibrated, RankBy::M, RankBy::C]
            .into_iter()
            .filter(|other| *other != metric && other.suits(self.constant.is_some()))
            .collect();
        let filled = |board: &Board| self.board.of(*board).next().is_some();
        let named = boards
            .iter()
            .any(|board| *board != Board::Main && filled(board));
        let row = |standing: &Standing<'_>| {
            let info = standing.best.info();
            let rank = standing
                .rank
                .map_or(Cell::Empty, |rank| Cell::number(rank as f64, 0));
            let (value, error) = (standing.best.value, standing.best.error);
            let mut row = vec![
                rank,
                Cell::text(&info.team),
                Cell::text(&info.method),
                Cell::text(title(info)),
                Cell::text(files(info.contents)),
                // One cell would give the error two digits, and the value as many decimals.
                Cell::number(rounded(value, digits), digits),
                Cell::number(rounded_up(error, digits), digits),
            ];
            row.extend(others.iter().map(|other| {
                // No more decimals than the organiser's, where he chose fewer than the metric's.
                let fewer = metric.decimals().saturating_sub(digits);
                let digits = other.decimals().saturating_sub(fewer);
                let (value, error) = other.of(&standing.best.entry.sets, self.constant);
                match rounded_to_error(value, error, digits) {
                    Some((value, digits)) => Cell::number(value, digits),
                    None => Cell::Empty,
                }
            }));
            row.extend([
                Cell::text(received(info)),
                Cell::number(standing.entries.len() as f64, 0),
            ]);
            if named {
                row.push(Cell::text(match standing.board {
                    Board::Main => "main".to_owned(),
                    Board::Late => "late".to_owned(),
                    Board::Partial => format!("{} of {all} sets", standing.best.entry.sets.len()),
                }));
            }
            row
        };
        let mut notes = vec![metric.meaning().to_owned()];
        notes.push("Each team is ranked by its best entry. Teams share a rank if their difference is below its error or not printed.".into());
        notes.extend(self.zero_note());
        notes.extend(self.expected_note());
        let standings = || boards.iter().flat_map(|board| self.board.of(*board));
        let mut rows: Vec<Vec<Cell>> = standings().map(row).collect();
        if boards.contains(&Board::Main) {
            let zero = metric.of_zero_shear(self.zero_shear.unwrap_or(f64::NAN));
            let behind = |standing: &Standing<'_>| {
                standing.board != Board::Main || better(metric, zero, standing.best.value)
            };
            let mut zeros = vec![Cell::Empty; 7 + others.len() + 2 + usize::from(named)];
            zeros[1] = Cell::text(ZERO_SHEAR);
            zeros[2] = Cell::text("no image");
            zeros[3] = Cell::text("reference: an entry of zeros");
            zeros[5] = Cell::number(rounded(zero, digits), digits);
            rows.insert(standings().position(behind).unwrap_or(rows.len()), zeros);
        }
        let mut headings = vec![
            Heading::new("rank", "rank"),
            Heading::new("team", "team"),
            Heading::new("method", "method"),
            Heading::new("title", "title"),
            Heading::new("files", "files"),
            Heading::new(key(metric).0, metric.label()),
            Heading::new(key(metric).1, "± error"),
        ];
        headings.extend(
            others
                .iter()
                .map(|other| Heading::new(key(*other).0, other.label())),
        );
        headings.extend([
            Heading::new("received", "received (UTC)"),
            Heading::new("entries", "entries"),
        ]);
        if named {
            headings.push(Heading::new("board", "board"));
        }
        Table {
            title: format!("Leaderboard of {}", self.challenge.name),
            headings,
            rows,
            notes,
        }
    }

    /// Entries that share files or shapes with an earlier one.
    fn copies(&self) -> Table {
        let row = |copy: &NearCopy<'_>| {
            let name = |info: &EntryInfo| format!("{}: {}", info.team, info.method);
            vec![
                Cell::text(name(copy.entry)),
                Cell::text(name(copy.earlier)),
                Cell::text(copy.reason()),
            ]
        };
        Table {
            title: "Near copies".into(),
            headings: vec![
                Heading::new("entry", "entry"),
                Heading::new("earlier", "earlier entry"),
                Heading::new("reason", "reason"),
            ],
            rows: self.copies.iter().map(row).collect(),
            notes: Vec::new(),
        }
    }

    /// The expected Q, if the metric is Q.
    fn expected_of_metric(&self) -> Option<&Expected> {
        self.expected.filter(|_| self.metric() == RankBy::Q)
    }

    /// Q of zero shear on boards of other metrics, too: whoever reads Q elsewhere must see it.
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

    fn expected_note(&self) -> Option<String> {
        let Expected {
            catalogues,
            spectra,
            without,
        } = self.expected_of_metric()?;
        let cell = |value: f64| Cell::with_error(rounded(value, 0), Some(f64::NAN), 2).digits();
        let (catalogues, spectra) = (cell(*catalogues)?.0, cell(*spectra)?.0);
        let without = match without.as_slice() {
            [] => String::new(),
            sets => {
                let sets: Vec<String> = sets.iter().map(u32::to_string).collect();
                format!(" Sets {} are left out.", sets.join(", "))
            }
        };
        Some(format!(
            "Expected Q of a perfect method with the smallest possible noise: {catalogues} for catalogues, {spectra} for power spectra without noise power.{without}"
        ))
    }

    /// Entries that were not scored or do not count.
    pub fn failures(&self) -> Table {
        let refused = self.refused.iter().map(|refused| {
            let name = refused.path.file_name().unwrap_or_default();
            vec![
                Cell::text(name.to_string_lossy()),
                Cell::text(&refused.team),
                Cell::text(&refused.reason),
            ]
        });
        let excluded = self.board.excluded.iter().map(|(info, reason)| {
            vec![
                Cell::text(&info.method),
                Cell::text(&info.team),
                Cell::text(reason),
            ]
        });
        Table {
            title: "Entries without a rank".into(),
            headings: vec![
                Heading::new("entry", "entry"),
                Heading::new("team", "team"),
                Heading::new("reason", "reason"),
            ],
            rows: refused.chain(excluded).collect(),
            notes: Vec::new(),
        }
    }

    /// The metric of each entry of the best teams.
    fn history(&self) -> LinePlot {
        let digits = self.disclosure.digits;
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
        if let Some(expected) = self.expected_of_metric() {
            for (label, value, colour) in [
                (
                    "expected, catalogues",
                    expected.catalogues,
                    EXPECTED_COLOURS[0],
                ),
                ("expected, spectra", expected.spectra, EXPECTED_COLOURS[1]),
            ] {
                let (x, y) = (vec![0.5, last + 0.5], vec![rounded(value, 0); 2]);
                series.push(Series::new(label, x, y, Style::Dashed, colour));
            }
        }
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

    /// The page.
    ///
    /// # Errors
    /// If a figure cannot be drawn.
    pub fn report(&self) -> Result<Report, FigureError> {
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
        if self.disclosure.detail {
            sections.push(self.detail()?);
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
        let mut settings = vec![
            ("Version of the data".to_owned(), version.to_string()),
            ("Kind".to_owned(), kind.title.to_owned()),
            (
                "Data".to_owned(),
                format!(
                    "{} sets of {} images with {2} × {2} galaxies",
                    data.sets.len(),
                    data.images,
                    data.grid
                ),
            ),
            ("Metric".to_owned(), rules.metric.label().to_owned()),
            ("Decimals".to_owned(), self.disclosure.digits.to_string()),
        ];
        settings.push((
            "Program".to_owned(),
            format!("shearq {}", shearq_dataset::VERSION),
        ));
        Ok(Report {
            title: name.clone(),
            subtitle: format!("{}: leaderboard", kind.title),
            sections,
            settings,
            ..Report::default()
        })
    }

    /// Q of each set.
    fn detail(&self) -> Result<Section, FigureError> {
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
        map.decimals = map.decimals.min(self.disclosure.digits);
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
    ///
    /// # Errors
    /// If a figure cannot be drawn or a file cannot be written.
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
