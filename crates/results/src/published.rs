//! Challenges that others ran and whose truth is public. Each is a module with the same interface: truth, submission, metrics,
//! pre-submission and leaderboard. GREAT10 is the format of `score`, `pack` and `check` themselves.
//!
//! A further challenge is a module with a type that implements [`PublicBranch`], and a line in [`CHALLENGES`].

pub mod great08;
pub mod great3;

use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};
use shearq_dataset::threads::Pool;
use shearq_files::table::{self, MAX_ROWS, Named, Place};
use shearq_files::{FileError, atomic, names_of};
use shearq_quantities::Shear;
use shearq_quantities::statistics::{RunningMean, scatter};
use shearq_render::figure::{FigureError, LinePlot, PanelGrid};
use shearq_render::html::{Block, Picture, Section};
use shearq_render::table::{Cell, Table};
use shearq_scoring::Line;
use shearq_scoring::great3::Branch;

/// A challenge by the name that users type.
#[derive(Debug)]
pub struct PublicChallenge {
    pub name: &'static str,
    /// Its branches by name; empty if it has a single one.
    pub branches: fn() -> Vec<String>,
    branch: fn(Option<&str>) -> Option<Box<dyn PublicBranch>>,
}

pub static CHALLENGES: [PublicChallenge; 2] = [
    PublicChallenge {
        name: "great3",
        branches: || Branch::all().map(|own| own.to_string()).collect(),
        branch: |name| Some(Box::new(great3::Great3(Branch::named(name?)?))),
    },
    PublicChallenge {
        name: "great08",
        branches: Vec::new,
        branch: |name| {
            name.is_none()
                .then(|| Box::new(great08::Great08) as Box<dyn PublicBranch>)
        },
    },
];

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
    /// Subfields of the branch: 200 unless it is simulated.
    pub subfields: usize,
    /// Galaxies per side of a subfield: 100 unless it is simulated.
    pub grid: usize,
    /// Whether a galaxy with one component that was not measured is left out of both. The challenge's program leaves out single
    /// components, so that the two means are over different galaxies.
    pub whole_galaxies: bool,
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

/// Standard errors by which the slope of an entry on the true shear must exceed zero: below, it contains no shear that could be
/// ranked.
pub const MIN_ENTRY_SLOPE_SIGNIFICANCE: f64 = 3.0;
// Least slope of an entry that measures shear: below, m < −0.9 is no bias of a method. `bias` has the same limit.
const MIN_SHEAR_SLOPE: f64 = 0.1;

// Slope of the measured on the true values, with its standard error.
#[derive(Clone, Copy)]
struct Slope {
    value: f64,
    error: f64,
}

impl Slope {
    // `None` if the values do not determine it.
    fn of(pairs: &[(f64, f64)]) -> Option<Self> {
        let line = Line::through(pairs);
        let (value, error) = (line.slope, line.slope_error());
        (pairs.len() > 2 && line.is_determined()).then_some(Slope { value, error })
    }

    fn differs_from(self, other: f64) -> bool {
        (self.value - other).abs() > MIN_ENTRY_SLOPE_SIGNIFICANCE * self.error
    }

    // Whether it is above zero, and not below `least`.
    fn is_clear(self, least: f64) -> bool {
        self.value > 0.0
            && self.differs_from(0.0)
            && (self.value >= least || !self.differs_from(least))
    }
}

impl Display for Slope {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3} ± {:.3}", self.value, self.error)
    }
}

// Why submitted shears are no measurement of those in the file `truth`. `pairs` are true and submitted shears.
fn disagreement(pairs: &[(Shear, Shear)], truth: &Path) -> Option<String> {
    let component = |g: Shear, k: usize| [g.e1, g.e2][k];
    let slope = |of: usize, on: usize| {
        let values = pairs
            .iter()
            .map(|(g, own)| (component(*g, on), component(*own, of)));
        Slope::of(&values.collect::<Vec<_>>())
    };
    let (Some(g1), Some(g2), Some(g1_on_g2), Some(g2_on_g1)) =
        (slope(0, 0), slope(1, 1), slope(0, 1), slope(1, 0))
    else {
        return Some(format!(
            "whether it follows the true shear cannot be determined (found {} fields in {}, expected at least 3 whose true g1 and g2 differ)",
            pairs.len(),
            truth.display()
        ));
    };
    let (own, cross) = ([g1, g2], [g1_on_g2, g2_on_g1]);
    let wrong = own
        .iter()
        .position(|slope| !slope.is_clear(MIN_SHEAR_SLOPE))?;
    let stronger =
        |k: usize| cross[k].differs_from(0.0) && cross[k].value.abs() > own[k].value.abs();
    let (found, name) = (own[wrong], ["g1", "g2"][wrong]);
    let cause = if stronger(0) && stronger(1) {
        "g1 and g2 are probably exchanged"
    } else if found.differs_from(0.0) && found.value <= -MIN_SHEAR_SLOPE {
        "its sign is probably wrong"
    } else {
        "it contains no measurable shear"
    };
    Some(format!(
        "{name} does not follow the true {name} (found a slope of {found}, expected about 1): {cause}"
    ))
}

// Largest residual of a field in standard deviations of the others, and least one in the scatter of the true shears: exchanged fields
// have residuals of about this scatter. Chosen by hand.
const MAX_FIELD_RESIDUAL: f64 = 8.0;
const MIN_ODD_RESIDUAL: f64 = 0.5;
// Share of the fields from which on they are no exceptions: the submission is of another kind then. Chosen by hand.
const MAX_ODD_SHARE: f64 = 0.25;

// A warning about fields that follow the truth differently from the others. Each of `quantities` has the true and the submitted
// value of each field.
fn odd_fields(quantities: &[Vec<(f64, f64)>]) -> Option<String> {
    let (mut odd, mut count) = (BTreeSet::new(), 0);
    for pairs in quantities {
        count = pairs.len();
        let residuals = pairs.iter().map(|(truth, own)| own - truth);
        let residuals: Vec<f64> = residuals.collect();
        let (centre, deviation) = scatter(&mut residuals.clone())?;
        let mut true_values = RunningMean::default();
        pairs.iter().for_each(|(truth, _)| true_values.add(*truth));
        let most = (MAX_FIELD_RESIDUAL * deviation).max(MIN_ODD_RESIDUAL * true_values.deviation());
        odd.extend((0..count).filter(|k| (residuals[*k] - centre).abs() > most));
    }
    let names: Vec<String> = odd.iter().map(usize::to_string).collect();
    (!names.is_empty() && (names.len() as f64) < MAX_ODD_SHARE * count as f64).then(|| {
        format!(
            "{} of {count} fields do not follow the truth as the others do: {}. Were fields exchanged?",
            names.len(),
            names_of(&names)
        )
    })
}

// A table that a participant or an organiser wrote. Each wanted column has several names; the last ones may be absent, and are
// then empty.
struct Columns<'a> {
    names: &'a [&'a [&'a str]],
    required: usize,
    // Places of the columns in a text table without names, by its number of columns.
    unnamed: &'a [(usize, &'a [usize])],
}

// Programs write ID, id and Id.
fn is_named(name: &str, aliases: &[&str]) -> bool {
    aliases.iter().any(|own| name.eq_ignore_ascii_case(own))
}

impl Columns<'_> {
    fn read(&self, path: &Path) -> Result<Vec<Vec<f64>>, FileError> {
        Ok(self.read_all(path)?.0)
    }

    // The wanted columns, and the names of the others.
    fn read_all(&self, path: &Path) -> Result<(Vec<Vec<f64>>, Vec<String>), FileError> {
        let mut place = Place::of(path);
        let found = table::columns(&place)?;
        // A FITS file may have several tables: the first with all columns is meant. Of a text, words of a comment name columns only
        // if they are as many, which the comments of the challenge's own files are not.
        let picked = found.named.iter().find_map(|named| {
            let places = self.places_in(&named.names)?;
            Some((named, places))
        });
        let is_number = |word: &String| word.parse::<f64>().is_ok();
        let header = |named: &&Named| !named.names.iter().all(is_number);
        let (names, chosen) = match (picked, found.named.iter().find(header)) {
            (Some((named, places)), _) => {
                place.table = named.table.as_ref().map(|head| head.number.to_string());
                let name = |place: usize| match named.doubtful {
                    true => (place + 1).to_string(),
                    false => named.names[place].clone(),
                };
                let chosen = places.into_iter().map(|place| place.map(name));
                (&*named.names, chosen.collect::<Vec<_>>())
            }
            // By its places, `# ID e2 e1 weight` would exchange the components.
            (
                None,
                Some(Named {
                    names, doubtful, ..
                }),
            ) => {
                let (of, advice) = match doubtful {
                    true => (
                        "comment",
                        ". Try: these names, or no comment of as many words as columns",
                    ),
                    false => ("columns", ""),
                };
                let message = format!(
                    "found the {of} {}, expected {}{advice}",
                    names.join(", "),
                    self.described()
                );
                return Err(FileError {
                    no_column: !doubtful,
                    ..FileError::new(path, message)
                });
            }
            (None, None) => (&[][..], self.unnamed(path, &found)?),
        };
        let wanted: Vec<&str> = chosen.iter().flatten().map(String::as_str).collect();
        let read = table::read_from(&place, Some(&wanted), MAX_ROWS)?;
        let column = |name: &Option<String>| match name {
            None => Ok(Vec::new()),
            Some(name) => Ok(table::numbers(&read, name, path)?.into_owned()),
        };
        let columns = chosen
            .iter()
            .map(column)
            .collect::<Result<_, FileError>>()?;
        let is_wanted = |name: &&String| self.names.iter().any(|own| is_named(name, own));
        let others = names.iter().filter(|name| !is_wanted(name)).cloned();
        Ok((columns, others.collect()))
    }

    // The place of each wanted column among `names`; `None` if one is missing.
    fn places_in(&self, names: &[String]) -> Option<Vec<Option<usize>>> {
        let picked = self.names.iter().zip(0..).map(|(aliases, k)| {
            match names.iter().position(|name| is_named(name, aliases)) {
                None if k < self.required => None,
                place => Some(place),
            }
        });
        picked.collect()
    }

    // The numbers of the wanted columns in a table without names.
    fn unnamed(
        &self,
        path: &Path,
        found: &table::Columns,
    ) -> Result<Vec<Option<String>>, FileError> {
        let count = found.unnamed.len();
        let Some((_, places)) = self.unnamed.iter().find(|(n, _)| *n == count) else {
            let message = format!("found {count} columns, expected {}", self.described());
            return wrong(path, message);
        };
        // `# columns: ID g2 g1 w` and `# ID | g2 | g1 | w` state an order, too, but not which word is which column. One that begins
        // with the order of the columns, such as `# index g1 g2 (true shear)`, agrees with it.
        let agrees = |words: &[String]| {
            let mut pairs = self.names.iter().zip(*places);
            pairs.all(|(aliases, place)| is_named(&words[*place], aliases))
        };
        let states_names = |words: &&Vec<String>| {
            self.places_in(words).is_some() && !(words.len() > count && agrees(words))
        };
        if let Some(words) = found.remarks.iter().find(states_names) {
            let message = format!(
                "found {count} columns below the comment {}, expected one word per column. Try: these names alone, or no comment of them",
                words.join(" ")
            );
            return wrong(path, message);
        }
        let number = |k: usize| places.get(k).map(|place| (place + 1).to_string());
        Ok((0..self.names.len()).map(number).collect())
    }

    fn described(&self) -> String {
        let names = self.names.iter().zip(0..);
        let names = names.map(|(names, k)| match k < self.required {
            true => names[0].to_owned(),
            false => format!("[{}]", names[0]),
        });
        names.collect::<Vec<_>>().join(" ")
    }
}

// Identities are read as numbers; a fraction or a sign means another column, which `as usize` would hide.
fn whole(value: f64, end: usize) -> Option<usize> {
    let is_whole = value >= 0.0 && value < end as f64 && value.fract() == 0.0;
    is_whole.then_some(value as usize)
}

fn wrong<T>(path: &Path, fault: impl Display) -> Result<T, FileError> {
    Err(FileError::new(path, fault))
}
