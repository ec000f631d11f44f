//! `shearq score`.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use shearq_scoring::units::{Degrees, Pixels};
use shearq_scoring::{Noise, Options, TruthSign};

use super::arguments::{Printing, ScoreSettings, SetList, Threads};
use super::print;
use crate::io::layout::DataFolder;
use crate::io::run::Run;
use crate::pipeline::score::{Reading, ScoredSet, score_files, score_folder};
use crate::report::scores::{SetInput, one_set_json, per_set};
use crate::report::table::TableFormat;

/// Score ellipticities against the true shear: Q, Q_dn, M/2, √A.
///
/// Either a folder that `measure` wrote (`--data DATA --measured OUT`), or one set from plain files
/// (`--truth truth.csv CATALOGUE...`, one catalogue per image; CSV with a header, ASCII `x y e1 e2`,
/// FITS or Parquet by the file's ending). With `--format json` and plain files everything about the
/// set is printed, all eight conventions included.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Data folder with the true shear.
    #[arg(
        long,
        value_name = "DIR",
        requires = "measured",
        conflicts_with = "truth"
    )]
    data: Option<PathBuf>,
    /// Folder of catalogues that `measure` wrote.
    #[arg(long, value_name = "DIR", requires = "data")]
    measured: Option<PathBuf>,
    /// True shear of one set: x, y, g1, g2.
    #[arg(long, value_name = "FILE", requires = "catalogues")]
    truth: Option<PathBuf>,
    /// Catalogues of that set, one per image.
    #[arg(value_name = "CATALOGUE", requires = "truth")]
    catalogues: Vec<PathBuf>,
    /// Sets to score [default: all that were measured].
    #[arg(long, value_name = "LIST", requires = "data")]
    sets: Option<SetList>,
    /// Noise variance per component, galaxy and image, for Q_dn [default: measured from the scatter
    /// between images].
    #[arg(long, value_name = "V")]
    noise_var: Option<f64>,
    /// Sign of g2 in the truth file [default: challenge for --truth, the layout's for --data].
    #[arg(long, value_enum)]
    truth_sign: Option<SignArgument>,
    /// Pixels a side of a grid cell, for --truth.
    #[arg(long, value_name = "PX", default_value_t = 48.0)]
    stamp: f64,
    /// Side of the field in degrees, for --truth.
    #[arg(long, value_name = "DEG", default_value_t = 10.0)]
    field: f64,
    /// Columns of the catalogues, for --truth.
    #[arg(
        long,
        value_name = "X,Y,E1,E2",
        default_value = "x,y,e1,e2",
        value_delimiter = ',',
        num_args = 1
    )]
    columns: Vec<String>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    settings: ScoreSettings,
    #[command(flatten)]
    threads: Threads,
}

/// Sign of g2 on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum SignArgument {
    /// Minus the standard g2, as the challenge's truth files hold it.
    Challenge,
    /// Positive along x = y.
    Standard,
}

impl From<SignArgument> for TruthSign {
    fn from(sign: SignArgument) -> Self {
        match sign {
            SignArgument::Challenge => TruthSign::Challenge,
            SignArgument::Standard => TruthSign::Standard,
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let options = Options {
        definition: arguments.settings.definition(),
        noise: arguments.noise_var.map_or(Noise::Measured, Noise::Given),
        choice: arguments.settings.choice(),
    };
    match (&arguments.data, &arguments.measured, &arguments.truth) {
        (Some(data), Some(measured), None) => folder(arguments, data, measured, options),
        (None, None, Some(truth)) => files(arguments, truth, options),
        _ => bail!(
            "nothing to score: give --data DIR --measured DIR, or --truth FILE and its catalogues"
        ),
    }
}

fn folder(
    arguments: &Arguments,
    data: &PathBuf,
    measured: &PathBuf,
    options: Options,
) -> anyhow::Result<()> {
    let data = DataFolder::open(data)?;
    let run = Run::read(measured)?.with_context(|| {
        format!(
            "{}: there is no run.json; expected a folder that `shearq measure` wrote",
            measured.display()
        )
    })?;
    let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
    let threads = arguments.threads.number();
    let scored = score_folder(&data, measured, &run, sets, options, threads)?;
    let title = format!("Scores of {}", run.submission.name);
    let table = per_set(&scored, &title, options.definition, options.choice);
    print(&arguments.printing.render(&table))
}

fn files(arguments: &Arguments, truth: &PathBuf, options: Options) -> anyhow::Result<()> {
    let columns: Vec<&str> = arguments.columns.iter().map(String::as_str).collect();
    let columns: [&str; 4] = columns.as_slice().try_into().map_err(|_| {
        anyhow::anyhow!(
            "--columns names {} columns; expected four: x, y and the two components",
            columns.len()
        )
    })?;
    let reading = Reading {
        field: Degrees(arguments.field),
        stamp: Pixels(arguments.stamp),
        sign: arguments
            .truth_sign
            .map_or(TruthSign::Challenge, Into::into),
        columns,
    };
    let (score, rows) = score_files(
        truth,
        &arguments.catalogues,
        &reading,
        options,
        arguments.threads.number(),
    )?;
    let scored = ScoredSet {
        set: 0,
        score,
        rows,
    };
    if arguments.printing.format == TableFormat::Json {
        let name = |path: &PathBuf| path.display().to_string();
        let input = SetInput {
            case: truth
                .parent()
                .and_then(|folder| folder.file_name())
                .map_or_else(|| name(truth), |n| n.to_string_lossy().into_owned()),
            truth: name(truth),
            catalogues: arguments.catalogues.iter().map(name).collect(),
            definition: options.definition,
        };
        let mut text = serde_json::to_string_pretty(&one_set_json(&scored, &input))?;
        text.push('\n');
        return print(&text);
    }
    let title = format!("Scores against {}", truth.display());
    let table = per_set(&[scored], &title, options.definition, options.choice);
    print(&arguments.printing.render(&table))
}
