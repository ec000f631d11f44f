//! Arguments that several subcommands share, and names and `--help` lines of choices whose types belong to the layers below.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use shearq_bias::Design;
use shearq_catalogue::columns::{Names, Shapes};
use shearq_catalogue::recognition::read_presets;
use shearq_catalogue::request::{Request, Units};
use shearq_catalogue::roles::role_names;
use shearq_catalogue::truth::Expanded;
use shearq_challenge::kind::{Kind, RankBy};
use shearq_dataset::images::{ImageId, Shard};
use shearq_dataset::layout::MAX_SET;
use shearq_files::open::{SETTINGS, is_there, read_to_string};
use shearq_files::table::FileFormat;
use shearq_pipeline::gather::Square;
use shearq_render::figure::FigureError;
use shearq_render::html::Section;
use shearq_render::table::{Table, TableFormat};
use shearq_render::terminal::fitted;
use shearq_results::response::{Position, Shared};
use shearq_results::submit::Contents;
use shearq_results::views::pages;
use shearq_scoring::{Choice, Definition, TruthSign};
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::kinds::SETS;
use shearq_simulate::set::{FixedPsf, SimulationSettings};
use shearq_submissions::{Configuration, EllipticityType, Registry, Template};

use crate::origin::words_behind_command;
use crate::{print, print_json, print_table, tell};

// `1,2,7-9`, or `all`, which is empty: data folders have any sets, and simulations the 24 of the paper. Own code, because clap has
// no ranges in lists.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SetList(pub(super) Vec<u32>);

impl FromStr for SetList {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(SetList(Vec::new()));
        }
        let number = |part: &str| -> Result<u32, String> {
            match part.trim().parse() {
                Ok(set) if set <= MAX_SET => Ok(set),
                _ => Err(format!(
                    "expected sets such as `1,2,7-9`, or `all` (found `{part}`, expected a number from 0 to {MAX_SET})"
                )),
            }
        };
        // Sorted and without repetition, so that a list in another order resumes the same run.
        let mut sets = BTreeSet::new();
        for part in text.split(',') {
            // `-` cannot be a sign: no set is negative.
            match part.split_once('-') {
                Some((first, last)) => {
                    let (first, last) = (number(first)?, number(last)?);
                    if first > last {
                        return Err(format!(
                            "the range is empty (found {part}, expected {last}-{first})"
                        ));
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

// As `merge` expects it in the command that a shard prints at its end.
impl std::fmt::Display for SetList {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sets: Vec<String> = self.0.iter().map(u32::to_string).collect();
        match sets.as_slice() {
            [] => f.write_str("all"),
            sets => f.write_str(&sets.join(",")),
        }
    }
}

// Empty for all sets, as the crates below expect.
pub(super) fn sets_of(list: Option<&SetList>) -> &[u32] {
    list.map_or(&[], |list| &list.0)
}

impl SetList {
    pub(super) fn simulated(&self) -> anyhow::Result<Vec<u32>> {
        if let Some(set) = self.0.iter().find(|&&set| !(1..=SETS).contains(&set)) {
            anyhow::bail!(
                "--sets: this set cannot be simulated (found {set}, expected 1 to {SETS})"
            );
        }
        Ok(match self.0.is_empty() {
            true => (1..=SETS).collect(),
            false => self.0.clone(),
        })
    }
}

#[derive(Debug, Clone, Args)]
pub(super) struct Printing {
    #[command(flatten)]
    form: Form,
    /// Print all columns (c, m per component, null tests), even if the table is wider than the terminal.
    /// CSV and JSON have them always.
    #[arg(long)]
    wide: bool,
    /// Print only these metrics, in this order: column names of the CSV format, such as `q,q_calibrated,m_cross`.
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    metrics: Vec<String>,
}

impl Printing {
    pub(super) fn format(&self) -> TableFormat {
        self.form.format
    }

    pub(super) fn chooses(&self) -> bool {
        !self.metrics.is_empty()
    }

    fn chosen(&self, table: &Table) -> anyhow::Result<Table> {
        table.chosen(&self.metrics).map_err(|unknown| {
            let known = table.metrics().join(", ");
            anyhow::anyhow!(
                "--metrics: unknown metric (found {unknown:?}, expected some of {known})"
            )
        })
    }

    // Called before anything is written: a command that fails to print must leave nothing behind.
    pub(super) fn check(&self, table: &Table) -> anyhow::Result<()> {
        self.chosen(table).map(|_| ())
    }

    // CSV and JSON have all columns, because programs read these and a narrow terminal must not change their input.
    pub(super) fn print(&self, table: &Table) -> anyhow::Result<()> {
        let for_people = !matches!(self.form.format, TableFormat::Csv | TableFormat::Json);
        let mut shown = match (self.chooses(), self.wide || !for_people) {
            (true, _) => self.chosen(table)?,
            (false, true) => table.clone(),
            (false, false) => table.narrow(),
        };
        match (self.form.format, self.wide) {
            (TableFormat::Table, true) => print(&fitted(&shown, None)),
            // Users must learn that a narrow table is not all there is.
            (TableFormat::Table, false) if !self.chooses() => {
                let details = table.headings.iter().filter(|heading| heading.detail);
                let details: Vec<&str> = details.map(|heading| heading.label.as_str()).collect();
                if !details.is_empty() {
                    let note = format!("More with --wide: {}", details.join(", "));
                    shown.notes.push(note);
                }
                self.form.print(&shown)
            }
            _ => self.form.print(&shown),
        }
    }
}

/// How tables of any program are read.
#[derive(Debug, Args)]
pub(super) struct TableReading {
    // The roles are appended to this text.
    #[arg(
        long,
        help = columns_help(),
        value_name = "ROLE=COLUMN"
    )]
    columns: Vec<String>,
    /// Also recognise the surveys that this file describes, as `[[survey]]` in TOML: name, ellipticity (shear or distortion),
    /// required (columns that it must have) and columns (by role).
    #[arg(long, value_name = "FILE")]
    preset: Vec<PathBuf>,
    /// Type of the ellipticities [default: shear if they have a response, else responsivity for columns of HSM that are
    /// distortions, else shear].
    #[arg(long, value_parser = named::<Shapes>())]
    pub(super) ellipticity: Option<Shapes>,
    /// Independent units for errors: `rows`, `catalogues` or a column, such as `seed` [default: a column pair, seed or
    /// patch; else groups of catalogues if there are 20 or more; else rows].
    #[arg(long, value_name = "UNIT")]
    units: Option<String>,
    /// Leave out rows with missing numbers or without a true shear.
    #[arg(long)]
    drop_missing: bool,
    /// Artificial shear of metacalibration [default: 0.01].
    #[arg(long, value_name = "G", value_parser = positive)]
    pub(super) step: Option<f64>,
}

impl TableReading {
    pub(super) fn request(&self, found: Expanded) -> anyhow::Result<Request> {
        let mut names = Names::default();
        for text in split_columns(&self.columns) {
            names.add(text)?;
        }
        for path in &self.preset {
            names.add_presets(read_presets(path)?);
        }
        Ok(Request {
            names,
            shapes: self.ellipticity,
            units: match self.units.as_deref() {
                None => Units::Recognised,
                Some("rows") => Units::Rows,
                Some("catalogues") => Units::Catalogues,
                Some(column) => Units::Column(column.to_owned()),
            },
            drop_missing: self.drop_missing,
            step: self.step,
            ..Request::new(found)
        })
    }
}

/// The parts of lists of columns. Commas in parentheses and quotes are those of names: pandas calls a column of several levels
/// `('ref', 'i', 'e1')`.
pub(super) fn split_columns(lists: &[String]) -> Vec<&str> {
    let mut parts = Vec::new();
    for list in lists {
        let (mut depth, mut quote, mut first, mut own) = (0, None, 0, Vec::new());
        for (at, c) in list.char_indices() {
            match (quote, c) {
                (Some(open), _) if open == c => quote = None,
                (Some(_), _) => {}
                (None, '\'' | '"') => quote = Some(c),
                (None, '(') => depth += 1,
                (None, ')') => depth -= 1,
                (None, ',') if depth == 0 => {
                    own.push(&list[first..at]);
                    first = at + 1;
                }
                _ => {}
            }
        }
        own.push(&list[first..]);
        match quote.is_none() && depth == 0 {
            true => parts.extend(own),
            false => parts.extend(list.split(',')),
        }
    }
    parts
}

fn columns_help() -> String {
    format!(
        "Names of columns or formulas of them, such as `e1=g_1,e2=-g_2,w=weight`, `flag=flags & 4` or `e1=g1,e2=g2,e1_1p=g1_1p,e1_1m=g1_1m,e2_2p=g2_2p,e2_2m=g2_2m`; `ROLE=none` ignores a column that would be recognised. Roles: {}",
        role_names()
    )
}

#[derive(Debug, Clone, Args)]
pub(super) struct ReportFile {
    /// Write tables and plots to this file as one self-contained HTML page (.html).
    #[arg(long, value_name = "FILE", value_parser = page)]
    report: Option<PathBuf>,
}

impl ReportFile {
    pub(super) fn is_wanted(&self) -> bool {
        self.report.is_some()
    }

    pub(super) fn save(
        &self,
        title: &str,
        sections: impl FnOnce() -> Result<Vec<Section>, FigureError>,
        made_by: impl FnOnce() -> anyhow::Result<Vec<(String, String)>>,
    ) -> anyhow::Result<()> {
        // Sections are closures, because plots take seconds that a command without a report should not spend.
        if let Some(path) = &self.report {
            pages::save(path, title, sections()?, made_by()?)?;
        }
        Ok(())
    }
}

#[derive(Debug, Clone, Args)]
pub(super) struct Form {
    /// Output format; `csv` and `json` have every column in full precision.
    #[arg(long, value_parser = named::<TableFormat>(), default_value = "table")]
    pub(super) format: TableFormat,
}

impl Form {
    // The notes of a CSV table go to standard error, because CSV has no comments.
    pub(super) fn print(&self, table: &Table) -> anyhow::Result<()> {
        if self.format == TableFormat::Csv {
            for note in &table.notes {
                tell(format_args!("{note}"));
            }
        }
        match self.format {
            TableFormat::Table => print_table(table),
            TableFormat::Json => print_json(table.json()),
            format => print(&table.render(format)),
        }
    }
}

/// How a command whose results are files says what it did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SummaryFormat {
    Text,
    Json,
}

#[derive(Debug, Clone, Args)]
pub(super) struct SummaryArguments {
    /// How to say what was done.
    #[arg(long, value_parser = named::<SummaryFormat>(), default_value = "text")]
    format: SummaryFormat,
}

impl SummaryArguments {
    pub(super) fn is_json(&self) -> bool {
        self.format == SummaryFormat::Json
    }

    /// Prints an object on standard output if JSON is asked for.
    pub(super) fn print(&self, value: impl FnOnce() -> serde_json::Value) -> anyhow::Result<()> {
        match self.format {
            SummaryFormat::Text => Ok(()),
            SummaryFormat::Json => print_json(value()),
        }
    }
}

// Commands that read a table from standard input.
const FROM_STANDARD_INPUT: [&str; 7] = [
    "bias", "compare", "gather", "mean", "pack", "score", "simulate",
];

/// The arguments of a command, where `-` and pipes are a file with what is read from them: tables are read twice.
pub(super) struct StandardInput {
    pub(super) arguments: Vec<OsString>,
    // Removed with this value.
    _folder: Option<tempfile::TempDir>,
}

impl StandardInput {
    pub(super) fn read(arguments: &[OsString]) -> std::io::Result<Self> {
        let mut read = StandardInput {
            arguments: arguments.to_vec(),
            _folder: None,
        };
        let first = arguments.len() - words_behind_command(arguments).len();
        let command = arguments.get(first.saturating_sub(1));
        let command = command.and_then(|word| word.to_str());
        if !command.is_some_and(|command| FROM_STANDARD_INPUT.contains(&command)) {
            return Ok(read);
        }
        let pipes: Vec<usize> = (first..arguments.len())
            .filter(|&at| arguments[at] == "-" || is_pipe(&arguments[at]))
            .collect();
        if pipes.is_empty() {
            return Ok(read);
        }
        let folder = tempfile::tempdir()?;
        for at in pipes {
            // Errors name the file.
            let (mut from, name): (Box<dyn std::io::Read>, _) = match arguments[at] == "-" {
                true => (Box::new(std::io::stdin().lock()), "standard-input".into()),
                false => (
                    Box::new(std::fs::File::open(&arguments[at])?),
                    format!("pipe-{at}"),
                ),
            };
            let path = folder.path().join(name);
            std::io::copy(&mut from, &mut std::fs::File::create(&path)?)?;
            read.arguments[at] = path.into();
        }
        read._folder = Some(folder);
        Ok(read)
    }
}

// `/dev/stdin`, and the pipes that a shell makes of `<(COMMAND)`.
fn is_pipe(word: &OsStr) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        let is_device = Path::new(word).starts_with("/dev");
        let kind = || std::fs::metadata(word).map(|found| found.file_type());
        is_device && kind().is_ok_and(|kind| kind.is_fifo())
    }
    #[cfg(not(unix))]
    {
        let _ = word;
        false
    }
}

/// Paths of a list in which `@FILE` stands for the lines of a file, and a name with `*` or `?` that is no file for all that it
/// matches, in order: a shell has no room for the names of 10,000 catalogues.
pub(super) fn listed(paths: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for path in paths {
        let text = path.to_string_lossy();
        if let Some(list) = text.strip_prefix('@').filter(|_| !path.exists()) {
            let lines = read_to_string(Path::new(list), SETTINGS)
                .with_context(|| format!("{text}: cannot read the list of files"))?;
            let names = lines.lines().map(str::trim).filter(|line| !line.is_empty());
            all.extend(names.map(PathBuf::from));
        } else if text.contains(['*', '?']) && !is_there(path) {
            let found = glob::glob(&text).with_context(|| text.to_string())?;
            let first = all.len();
            for one in found {
                all.push(one?);
            }
            anyhow::ensure!(
                all.len() > first,
                "{text}: no file has such a name. Try: ls {text}"
            );
        } else {
            all.push(path.clone());
        }
    }
    Ok(all)
}

// As in GREAT10. The seed is arbitrary.
const GRID: u16 = 100;
const SEED: u64 = 1;

#[derive(Debug, Clone, Args)]
pub(super) struct SimulationArguments {
    /// Galaxies per side of a simulated image.
    #[arg(long, value_name = "N", default_value_t = GRID, value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: u16,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = SEED)]
    seed: u64,
    /// Factor on the simulated shear power spectrum.
    #[arg(long, value_name = "A", default_value_t = 1.0)]
    amplitude: f64,
    /// Extra slope of the simulated shear power spectrum, with its pivot at ℓ = 1000.
    #[arg(long, value_name = "T", default_value_t = 0.0)]
    tilt: f64,
    /// PSFs of sets whose PSFs are fixed (2, 5, 8, …): `field`, a field over the image that is the same in all images, as in
    /// GREAT10; `one`, one PSF of all galaxies, with which the data are half as large.
    #[arg(long, value_name = "WHAT", default_value = "field", value_parser = fixed_psf())]
    fixed_psf: FixedPsf,
}

fn fixed_psf() -> impl TypedValueParser<Value = FixedPsf> {
    PossibleValuesParser::new(["field", "one"]).map(|name| match name.as_str() {
        "one" => FixedPsf::One,
        _ => FixedPsf::Field,
    })
}

impl SimulationArguments {
    pub(super) fn settings(&self) -> anyhow::Result<SimulationSettings> {
        let spectrum = ShearSpectrum {
            amplitude: self.amplitude,
            tilt: self.tilt,
            ..ShearSpectrum::default()
        };
        let settings = SimulationSettings {
            spectrum,
            fixed_psf: self.fixed_psf,
            ..SimulationSettings::new(self.seed, usize::from(self.grid))
        };
        settings.validate()?;
        Ok(settings)
    }

    // Clap cannot refuse options that have a default. An option that is given with its default value does no harm.
    pub(super) fn must_be_unused(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            self.settings()? == SimulationSettings::new(SEED, usize::from(GRID)),
            "--grid, --seed, --amplitude, --tilt and --fixed-psf apply to simulated data only. Try: without them"
        );
        Ok(())
    }
}

#[derive(Debug, Clone, Args)]
pub(super) struct Sharding {
    /// Process only shard K of N: an N-th of the images. N processes may write to one folder at the same time.
    /// `merge` then checks that the folder is complete (docs/large-jobs.md).
    #[arg(long, value_name = "K/N")]
    pub(super) shard: Option<Shard>,
}

impl Sharding {
    pub(super) fn part(&self, all: &[ImageId]) -> Vec<ImageId> {
        self.shard.unwrap_or(Shard::WHOLE).part(all)
    }
}

#[derive(Debug, Clone, Args)]
pub(super) struct Threads {
    /// Number of worker threads; results do not depend on it [default: one per core].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

impl Threads {
    pub(super) fn number(&self) -> usize {
        self.threads.map_or_else(
            // It respects the CPU quota and affinity of a batch system, unlike the number of cores.
            || std::thread::available_parallelism().map_or(1, usize::from),
            usize::from,
        )
    }
}

#[derive(Debug, Clone, Default, Args)]
pub(super) struct ScoreSettings {
    /// Definition of bandpowers and Q.
    #[arg(long, value_parser = named::<Definition>(), default_value = "leaderboard")]
    pub(super) definition: Definition,
    /// Convention of signs and axes: 1 to 8 (5 is the standard one), `matched` or `best`. `matched` correlates best
    /// with the truth of all sets; `best` has the highest Q of each set, as on the leaderboard [default: 5 for
    /// catalogues by shearq, matched for others].
    #[arg(long, value_name = "WHICH")]
    pub(super) convention: Option<Choice>,
}

pub(super) fn configurations(names: &[String]) -> anyhow::Result<Vec<Configuration>> {
    given_once(names)?;
    let registry = Registry::embedded()?;
    let configurations = names.iter().map(|name| registry.get(name));
    configurations
        .map(|found| Ok(found?.configuration))
        .collect()
}

// A configuration that is given twice would be compared with itself, with an error of zero.
pub(super) fn given_once(submissions: &[String]) -> anyhow::Result<()> {
    for (k, name) in submissions.iter().enumerate() {
        anyhow::ensure!(
            !submissions[..k].contains(name),
            "--submission {name} is given twice"
        );
    }
    Ok(())
}

// A page of another ending opens as text.
pub(super) fn page(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    match ending == "html" || ending == "htm" {
        true => Ok(path),
        false => Err("expected a name that ends in .html".into()),
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok();
    number
        .filter(|number: &f64| number.is_finite() && *number > 0.0)
        .ok_or_else(|| "expected a positive number".into())
}

// Clap's `ValueEnum` cannot be derived here: the types belong to crates without clap, so that libraries do not compile it.
pub(crate) trait Named: Copy + Send + Sync + 'static {
    const ALL: &[(Self, &str, &str)];
}

// The name that a value had in version 0.2.
fn earlier(name: &str) -> Option<&'static str> {
    (name == "shears").then_some("arms")
}

pub(crate) fn named<T: Named>() -> impl TypedValueParser<Value = T> {
    let names = T::ALL
        .iter()
        .map(|(_, name, help)| PossibleValue::new(*name).help(*help).aliases(earlier(name)));
    // Other names were refused by `PossibleValuesParser`, so that the first value is never used as a default.
    PossibleValuesParser::new(names).map(|given| {
        let is_given = |name: &str| name == given || earlier(name) == Some(given.as_str());
        let found = T::ALL.iter().find(|(_, name, _)| is_given(name));
        found.unwrap_or(&T::ALL[0]).0
    })
}

macro_rules! choices {
    ($($of:ty { $($variant:ident: $name:literal, $help:literal;)+ })+) => {
        $(impl Named for $of {
            const ALL: &[(Self, &str, &str)] = &[$((Self::$variant, $name, $help)),+];
        })+
    };
}

choices! {
    Kind {
        Great10: "great10", "GREAT10 Galaxy Challenge";
        Great3: "great3", "Sets with one shear each, ranked by Q_c";
        Scenes: "scenes", "Exposures with one shear each for pipelines with detection, ranked by the shear error";
    }
    FileFormat {
        Parquet: "parquet", "Parquet";
        Fits: "fits", "FITS binary table";
    }
    TableFormat {
        Table: "table", "For reading on a terminal";
        Json: "json", "Machine-readable, full precision";
        Csv: "csv", "Comma-separated, full precision, values and errors in separate columns. An apostrophe protects text that spreadsheets would execute as a formula";
        Markdown: "markdown", "Markdown";
        Latex: "latex", "A LaTeX tabular";
    }
    SummaryFormat {
        Text: "text", "In words on standard error";
        Json: "json", "Also as JSON on standard output";
    }
    Shared {
        Survey: "survey", "All";
        Set: "set", "Those of a set";
        Image: "image", "Those of an image";
    }
    Position {
        Sky: "ra,dec", "Right ascension and declination in degrees, for shears in the frame of the sky";
        Pixel: "x,y", "Pixels of the image, for shears in their frame";
    }
    TruthSign {
        Challenge: "challenge", "Minus the standard g2, as in the challenge's truth files";
        Standard: "standard", "Positive along x = y";
    }
    EllipticityType {
        Shear: "shear", "(1 − q)/(1 + q) for an axis ratio q";
        Distortion: "distortion", "(1 − q²)/(1 + q²), converted to shear-type ellipticities";
    }
    Template {
        Linear: "linear", "The linear network in closed form (recommended)";
        Network: "network", "The Hopfield network of Nurbaeva et al. (2015)";
    }
    Square {
        Crop: "crop", "By the central square";
        Pad: "pad", "By missing pixels around them; PSFs are cropped";
    }
    Definition {
        Leaderboard: "leaderboard", "The arithmetic of the challenge";
        Corrected: "corrected", "Azimuthal averages over fixed bins";
    }
    Design {
        Single: "single", "One true shear";
        Pairs: "pairs", "+γ and −γ of the same galaxies";
        Arms: "shears", "The same galaxies under several test shears, such as ±g1 and ±g2";
        Fields: "fields", "One true shear per catalogue";
        Galaxies: "galaxies", "Shears that vary within catalogues";
        Rotated: "rotated", "Galaxies rotated by 90 degrees, in neighbouring rows or catalogues";
    }
    Shapes {
        Shear: "shear", "(1 − q)/(1 + q) for an axis ratio q";
        Converted: "distortion", "(1 − q²)/(1 + q²) for an axis ratio q, each converted to a shear";
        Responsivity: "responsivity", "The same, but the mean is divided by the responsivity 2(1 − e_rms²), as surveys do";
    }
    RankBy {
        Q: "q", "Q with the arithmetic of GREAT10's leaderboard";
        QCorrected: "q-corrected", "Q with azimuthal averages over fixed bins";
        QCalibrated: "q-calibrated", "Q after dividing by the measured response";
        M: "m", "Modulus of the multiplicative bias";
        C: "c", "Modulus of the additive bias, divided by the response";
        Qc: "qc", "GREAT3's Q_c, from m and c of sets with one shear each";
    }
    Contents {
        Catalogues: "catalogues", "Ellipticity catalogues";
        Spectra: "spectra", "Power spectra of the ellipticities averaged over the images, with their noise";
        CrossSpectra: "cross-spectra", "Shear power spectra from cross-spectra between groups of images; their noise averages to zero";
    }
}

/// A bit of a mask.
pub(crate) fn mask_bit(text: &str) -> Result<u8, String> {
    let bit = text.parse().ok().filter(|bit| *bit <= 52);
    bit.ok_or_else(|| "expected a bit from 0 to 52: masks are read as numbers below 2^53".into())
}

/// Columns of a condition that shear does not change.
#[derive(Debug, Args)]
pub(crate) struct Unsheared {
    /// Carried columns in conditions that shear does not change, because they were not measured on images of the galaxies, such as
    /// z,tile.
    #[arg(
        long = "unsheared",
        id = "unsheared",
        value_name = "NAMES",
        value_delimiter = ',',
        num_args = 1,
        requires = "condition"
    )]
    pub(crate) names: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commas_in_names_of_columns_separate_nothing() {
        for (list, expected) in [
            ("e1=a,e2=b", &["e1=a", "e2=b"][..]),
            (
                "e1=('ref', 'i', 'e1'),e2=('ref', 'i', 'e2')",
                &["e1=('ref', 'i', 'e1')", "e2=('ref', 'i', 'e2')"],
            ),
            ("flag=band == 'a,(b',w=x", &["flag=band == 'a,(b'", "w=x"]),
            ("e1=x(,e2=y'", &["e1=x(", "e2=y'"]),
        ] {
            assert_eq!(split_columns(&[list.to_owned()]), expected);
        }
    }

    #[test]
    fn set_lists_are_sorted_and_checked() {
        let parse = |text: &str| text.parse::<SetList>().map(|list| list.0);
        assert_eq!(parse("7-9,1,2,8"), Ok(vec![1, 2, 7, 8, 9]));
        let all = SetList(parse("all").unwrap());
        assert_eq!(all.simulated().unwrap().len(), 24);
        assert_eq!(all.to_string(), "all");
        for wrong in ["", "x", "3-1", "1,,2", "10000"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
