//! Public challenges: those that others ran, whose true shear was released. A challenge is a folder with its names and layout, released
//! truth, simulation, scoring, packing and published entries, behind [`PublicBranch`]; nothing else knows its name. A further one
//! is such a folder and a line in [`CHALLENGES`].
//!
//! Below it stay the arithmetic of metrics (`shearq_scoring`, which is published alone), and the names of released files
//! (`shearq_dataset::great3`), because a branch is measured as any folder of data is. GREAT10 is the format of `score`, `pack`
//! and `check` themselves, which blind challenges have too.
#![forbid(unsafe_code)]

mod agreement;
mod columns;
mod great08;
mod great3;

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};
use shearq_dataset::threads::{Pool, Progress};
use shearq_files::{FileError, atomic};
use shearq_pipeline::PipelineError;
use shearq_render::figure::{FigureError, LinePlot, PanelGrid};
use shearq_render::html::{Block, Picture, Section};
use shearq_render::table::{Cell, Table};
use shearq_simulate::galaxy::GalaxyError;

pub use agreement::MIN_ENTRY_SLOPE_SIGNIFICANCE;

/// A challenge by the name that users type.
#[derive(Debug)]
pub struct PublicChallenge {
    pub name: &'static str,
    /// Its branches by name; empty if it has a single one.
    pub branches: fn() -> Vec<String>,
    /// Branches that can be simulated.
    pub simulated: fn() -> Vec<String>,
    branch: fn(Option<&str>) -> Option<Box<dyn PublicBranch>>,
}

pub static CHALLENGES: [PublicChallenge; 2] = [great3::CHALLENGE, great08::CHALLENGE];

/// No challenge has this name, or the challenge no such branch.
#[derive(Debug, thiserror::Error)]
pub enum Unknown {
    #[error("--challenge: unknown challenge (found `{found}`, expected {expected})")]
    Challenge { found: String, expected: String },
    #[error("--branch: {challenge} has no such branch (found `{found}`, expected {expected})")]
    Branch {
        challenge: &'static str,
        found: String,
        expected: String,
    },
}

impl PublicChallenge {
    pub fn named(name: &str) -> Result<&'static Self, Unknown> {
        let found = CHALLENGES.iter().find(|own| own.name == name);
        found.ok_or_else(|| Unknown::Challenge {
            found: name.into(),
            expected: CHALLENGES.each_ref().map(|own| own.name).join(" or "),
        })
    }

    pub fn branch(&self, name: Option<&str>) -> Result<Box<dyn PublicBranch>, Unknown> {
        (self.branch)(name).ok_or_else(|| Unknown::Branch {
            challenge: self.name,
            found: name.unwrap_or("none").into(),
            expected: match (self.branches)() {
                branches if branches.is_empty() => "none".into(),
                branches => branches.join(", "),
            },
        })
    }
}

/// Where the truth of a branch is.
#[derive(Debug, Clone, Copy)]
pub struct Truth<'a> {
    /// A table, or a folder of the files that the organisers released.
    pub path: &'a Path,
    /// Table of the ellipticities of the PSF, if the challenge needs them and the folder has none.
    pub psf: Option<&'a Path>,
    /// Subfields, if the branch was simulated with another number than the challenge's.
    pub subfields: Option<usize>,
}

/// What differs between challenges and between their branches, each of which has a leaderboard.
pub trait PublicBranch {
    fn title(&self) -> String;
    /// Subfields of the challenge's own data; `None` if it has no such parts.
    fn subfields(&self) -> Option<usize>;
    /// Scores a submission.
    fn score(&self, truth: Truth<'_>, submission: &Path, pool: &Pool) -> Result<Score, FileError>;
    /// Refuses a submission that the challenge would not score as it is meant.
    fn check(&self, submission: &Path, subfields: Option<usize>) -> Result<(), FileError>;
    /// Makes a submission of catalogues of galaxies. `None` if the challenge has no pre-submission.
    fn pack(
        &self,
        packing: &Presubmitting<'_>,
        pool: &Pool,
    ) -> Option<Result<Presubmission, FileError>>;
    /// Simulates data of the branch with their truth, in the layout of the challenge. `start` gets the number of galaxies. `None`
    /// if the branch cannot be simulated.
    fn simulate(
        &self,
        simulation: &Simulation<'_>,
        threads: usize,
        start: &dyn Fn(u64) -> Box<dyn Progress>,
    ) -> Option<Result<Simulated, SimulationError>>;
    /// Published entries.
    fn leaderboard(&self) -> Vec<Entry>;
    /// Where the published entries are from.
    fn leaderboard_source(&self) -> Option<&'static str>;
}

/// Where the galaxies of a branch are.
#[derive(Debug, Clone, Copy)]
pub enum BranchCatalogues<'a> {
    /// In tables with a shear for each galaxy.
    Files(&'a [PathBuf]),
    /// In a folder of catalogues that `measure` wrote, whose ellipticities are divided by the mean response of their set.
    Measured(&'a Path),
}

/// Catalogues of a branch, and how they are summarised.
#[derive(Debug, Clone)]
pub struct Presubmitting<'a> {
    pub catalogues: BranchCatalogues<'a>,
    /// Subfields, and galaxies per side of each, if the branch was simulated with other numbers than the challenge's.
    pub subfields: Option<usize>,
    pub grid: Option<usize>,
    /// Whether a galaxy with one component that was not measured is left out of both. The challenge's program leaves out single
    /// components, so that the two means are over different galaxies.
    pub whole_galaxies: bool,
}

/// A branch to simulate.
#[derive(Debug, Clone)]
pub struct Simulation<'a> {
    pub seed: u64,
    /// Galaxies per side of a subfield.
    pub grid: usize,
    /// Subfields, if other than the challenge's number.
    pub subfields: Option<usize>,
    /// Table of fits to galaxies; without, they are drawn from a distribution.
    pub galaxies: Option<&'a Path>,
    /// Whether the galaxies are also simulated under the opposite shear, below `opposite`.
    pub opposite: bool,
    pub out: &'a Path,
}

/// A simulated branch.
#[derive(Debug, Clone)]
pub struct Simulated {
    /// New images, and all images.
    pub made: usize,
    pub images: usize,
    /// Where the images are, and their truth.
    pub folder: PathBuf,
    pub truth: PathBuf,
}

/// Why a branch cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum SimulationError {
    #[error("--grid: found {found}, expected at most {most} for {branch}")]
    Grid {
        found: usize,
        most: usize,
        branch: &'static str,
    },
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Galaxy(#[from] GalaxyError),
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
}

/// A submission file, and what to tell about it.
#[derive(Debug, Clone)]
pub struct Presubmission {
    pub text: String,
    pub note: String,
}

impl Presubmission {
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        atomic::write(path, self.text.as_bytes())
    }
}

/// A published entry of a leaderboard.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    pub team: String,
    pub method: String,
    pub q: f64,
    /// m₊, m×, c₊, c×; not a number if unknown.
    pub biases: [f64; 4],
}

/// One figure of a score.
#[derive(Debug, Clone)]
pub struct Figure {
    /// Name in JSON.
    pub key: &'static str,
    pub value: f64,
    /// Error by the challenge's own convention, where it has one.
    pub error: Option<f64>,
    pub jackknife: f64,
    /// Value of a submission of the true shear, where the challenge limits it.
    pub perfect: Option<f64>,
    /// What surveys need, as the challenge states it: Q, or the largest |bias|.
    pub requirement: Option<f64>,
    pub decimals: usize,
}

/// The score of a submission; Q is first.
#[derive(Debug, Clone)]
pub struct Score {
    /// Name of the branch in JSON, if the challenge has several.
    pub branch: Option<String>,
    pub figures: Vec<Figure>,
    /// What the figures come from, for a report.
    pub plots: Vec<LinePlot>,
    /// Why the entry is no measurement of the true shear, so that it has no rank.
    pub refusal: Option<String>,
    pub warnings: Vec<String>,
}

impl Score {
    pub fn q(&self) -> &Figure {
        &self.figures[0]
    }

    // The names of the challenge's own functions, so that programs for their output read it.
    pub fn json(&self) -> Value {
        let mut found = Map::new();
        if let Some(branch) = &self.branch {
            found.insert("branch".into(), branch.clone().into());
        }
        for figure in &self.figures {
            let key = figure.key;
            found.insert(key.into(), figure.value.into());
            if let Some(error) = figure.error {
                found.insert(format!("sigma_{key}"), error.into());
            }
            found.insert(format!("jackknife_{key}"), figure.jackknife.into());
        }
        found.into()
    }

    /// The section of a report.
    pub fn section(&self, title: &str) -> Result<Section, FigureError> {
        let mut blocks = vec![Block::Table(self.table(title.to_owned()))];
        if !self.plots.is_empty() {
            let panels = PanelGrid {
                title: String::new(),
                columns: 2,
                plots: self.plots.clone(),
            };
            let caption = "Fields of the submission beside the truth. Dashed: the requirement of the challenge.";
            blocks.push(Block::Figure(Picture::draw(&panels, "score", caption)?));
        }
        Ok(Section::new("score", title, blocks))
    }

    pub fn table(&self, title: String) -> Table {
        let mut table = Table::titled(title);
        let rows = &self.figures;
        table.column("figure", "Figure", rows, |own| Cell::text(own.key));
        table.column("value", "Value", rows, |own| {
            Cell::number(own.value, own.decimals)
        });
        let mut column = |key, label, value: fn(&Figure) -> Option<f64>| {
            table.column(key, label, rows, |own| {
                value(own).map_or(Cell::Empty, |value| Cell::number(value, own.decimals))
            });
        };
        column("error", "Error", |own| own.error);
        column("jackknife", "Jackknife", |own| Some(own.jackknife));
        column("perfect", "Perfect", |own| own.perfect);
        column("requirement", "Requirement", |own| own.requirement);
        table
    }
}

/// The leaderboard of a branch with own scores among the published entries, best first.
pub fn ranking(branch: &dyn PublicBranch, own: &[(String, Score)]) -> Table {
    let published = branch.leaderboard();
    let mut rows: Vec<(Entry, Option<f64>)> = own
        .iter()
        .map(|(name, score)| {
            let bias = |key: &str| {
                let figure = score.figures.iter().find(|figure| figure.key == key);
                figure.map_or(f64::NAN, |figure| figure.value)
            };
            let entry = Entry {
                team: "this".into(),
                method: name.clone(),
                q: score.q().value,
                biases: ["m_plus", "m_cross", "c_plus", "c_cross"].map(bias),
            };
            (entry, Some(score.q().jackknife))
        })
        .collect();
    // Published values have no error: the challenge gave none.
    rows.extend(published.into_iter().map(|entry| (entry, None)));
    rows.sort_by(|(a, _), (b, _)| b.q.total_cmp(&a.q));
    // A row without a team is the published best Q of the branch: a goal, but no entry that others rank behind.
    let mut ranks = 1..;
    let rows: Vec<(Option<usize>, Entry, Option<f64>)> = rows
        .into_iter()
        .map(|(entry, error)| {
            let rank = (!entry.team.is_empty()).then(|| ranks.next()).flatten();
            (rank, entry, error)
        })
        .collect();
    let mut table = Table::titled(format!("Leaderboard of {}", branch.title()));
    table.column("rank", "Rank", &rows, |own| {
        own.0
            .map_or(Cell::Empty, |rank| Cell::number(rank as f64, 0))
    });
    table.column("team", "Team", &rows, |own| Cell::text(&own.1.team));
    table.column("method", "Method", &rows, |own| Cell::text(&own.1.method));
    table.column("q", "Q", &rows, |own| Cell::with_error(own.1.q, own.2, 1));
    let biases = [
        ("m_plus", "m₊×10³", 1e3),
        ("m_cross", "m××10³", 1e3),
        ("c_plus", "c₊×10⁴", 1e4),
        ("c_cross", "c××10⁴", 1e4),
    ];
    for (k, (key, label, scale)) in biases.into_iter().enumerate() {
        table.column(key, label, &rows, |own| {
            Cell::number(scale * own.1.biases[k], 2)
        });
    }
    table
        .notes
        .extend(branch.leaderboard_source().map(Into::into));
    table
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
