use std::fmt::Write;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};
use shearq_bias::{BiasError, Design};

use crate::arguments::{Printing, ReportFile, TableReading, listed, named, positive};
use crate::origin::remember_columns;
use crate::progress::reading;
use crate::{Findings, made_by, tell};
use shearq_catalogue::expression::Expression;
use shearq_catalogue::request::{Binning, Edges, MAX_AXES, MAX_BINS, Request, Survey};
use shearq_catalogue::select::selection;
use shearq_catalogue::truth::{TrueSign, Truth, expand};
use shearq_dataset::images::Shard;
use shearq_files::{atomic, open};
use shearq_render::figure::{Figure, PictureFormat};
use shearq_render::table::{Cell, Table};
use shearq_results::baseline::catalogues::Units as BaselineUnits;
use shearq_results::bias::{BiasFailure, BiasResult, Summed, joined, sum_with_progress};
use shearq_results::views::bias::{
    Checked, Limit, bias_plot, bias_table, check, chosen_by_measurement, compared_table, of_design,
    of_other_images, of_pairing, section, with_failures,
};
use shearq_results::views::per_area::add_per_area;
use shearq_scoring::TruthSign;

/// Multiplicative and additive bias (m and c) of any program's catalogues.
///
/// Catalogues are FITS, Parquet or text tables with columns e1 and e2. Optional columns are the weight w, the responses
/// R11 and R22, a flag, and the true shear g1 and g2. Columns of HSM, ngmix metacal, metadetect and AnaCal are
/// recognised.
///
/// The design is recognised from the true shears: paired shears +γ and −γ, several such pairs, one shear per catalogue,
/// or shears that vary within a catalogue. Errors are from a jackknife over independent units, and contain the noise of
/// a star that several units share. The output names design and units.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    summing: Summing,
    #[command(flatten)]
    reading: TableReading,
    /// Exit with code 1 if |m| or |c| of all galaxies or of a bin exceeds a limit, such as `m=2e-3@3sigma`: by three standard
    /// errors. With --against, the limit is one of the difference. May be given several times.
    #[arg(long, value_name = "LIMIT")]
    fail_above: Vec<Limit>,
    /// Merge files that --sums wrote for shards of one list of catalogues.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["Summing", "TableReading"])]
    merge: Vec<PathBuf>,
    /// Print how many measurements determine m to this error, such as 1e-3. Needs no catalogues.
    #[arg(long, value_name = "ERROR", value_parser = planned_error, exclusive = true)]
    plan: Option<f64>,
    /// Write example catalogues `plus.csv` and `minus.csv` into this folder: 20,000 galaxies with m1 = 0.01, m2 = -0.02,
    /// c1 = 0.001 and c2 = -0.0005.
    #[arg(long, value_name = "DIR", exclusive = true)]
    example: Option<PathBuf>,
    /// Plot m and c to this file, PDF, PNG or SVG by its ending.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Area of the image of each catalogue in arcmin²: also print detections per arcmin², the shear error of 1 arcmin² and the
    /// effective number of galaxies per arcmin² (docs/scenes.md).
    #[arg(long, value_name = "ARCMIN2", value_parser = positive, conflicts_with_all = ["against", "like", "tomography"])]
    area: Option<f64>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    report: ReportFile,
}

// What catalogues are summed, and how: one group, because the files of `--merge` were summed already.
#[derive(Debug, Args)]
struct Summing {
    /// Catalogues, all with the same columns, or folders that `measure` or `run` wrote. FILE[TABLE] is one table of a
    /// FITS file.
    #[arg(value_name = "CATALOGUE", required_unless_present_any = ["merge", "plan", "example"])]
    catalogues: Vec<PathBuf>,
    /// Catalogues of another program on the same galaxies (the same images, if they state theirs), in the same order. The output contains both and the
    /// difference, with paired errors. A --truth table by catalogue contains those of both, or names of files that both
    /// have, in two folders.
    #[arg(long, value_name = "CATALOGUE", num_args = 1.., conflicts_with_all = ["sums", "shard", "plot", "report"])]
    against: Vec<PathBuf>,
    /// True g1 of all catalogues.
    #[arg(long, value_name = "G1", requires = "g2", conflicts_with = "truth")]
    g1: Option<f64>,
    /// True g2 of all catalogues.
    #[arg(long, value_name = "G2", requires = "g1", conflicts_with = "truth")]
    g2: Option<f64>,
    /// Table of true shears: columns catalogue, g1, g2 or id, g1, g2 or x, y, g1, g2 (within 1 pixel) [default: columns
    /// g1 and g2 of the catalogues, or the true shear of the data of a folder].
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Sign of the true g2 [default: as the file of --truth states; else, for x, y, g1, g2, the sign in which the shear is
    /// an E-mode field; else the sign with which e2 correlates at 5σ; required if these are unclear. Shears of options, of columns of
    /// the catalogues and of tables with the column catalogue: standard].
    #[arg(long, value_parser = named::<TruthSign>())]
    truth_sign: Option<TruthSign>,
    /// Also estimate in bins of a column or expression: `snr:5` has five bins with equally many galaxies,
    /// `flux/flux_error:5,10,20` has these edges (each bin contains its lower edge), and `TOMOBIN` a bin for each number or
    /// text. Up to three times, for bins of several quantities together.
    #[arg(long, value_name = "EXPRESSION[:BINS]", allow_hyphen_values = true, value_parser = parse_bins)]
    bins: Vec<Binning>,
    /// Weight simulated galaxies so that their distribution in the bins is that of this catalogue of a survey, and print m
    /// and c of the survey. Bins without simulated galaxies are named.
    #[arg(long, value_name = "CATALOGUE", requires = "bins", conflicts_with_all = ["against", "sums", "shard"])]
    like: Option<PathBuf>,
    /// Column of the survey's tomographic bins, for m and c of each [default: a column such as TOMOBIN or zbin].
    #[arg(long, value_name = "COLUMN", requires = "like", conflicts_with_all = ["against", "sums", "shard"])]
    tomography: Option<String>,
    /// Use only galaxies for which this holds, such as "snr > 10 and size < 4". Catalogues of linear configurations can
    /// also be cut by steps, such as "step(snr, 10, 1.5) and step(size, 2.5)", whose response to shear is included (see
    /// `select`). The response of other conditions on measured quantities needs sheared catalogues.
    // The command that keeps a selection is called select; clap would suggest --seed.
    #[arg(
        long = "where",
        alias = "select",
        value_name = "CONDITION",
        allow_hyphen_values = true
    )]
    condition: Option<String>,
    /// Columns of --where and --bins that shear does not change, because they were not measured on images of the galaxies, such as
    /// a redshift of another survey.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', num_args = 1)]
    unsheared: Vec<String>,
    /// Weight of each galaxy, a smooth formula of `snr`, `flux` and `size`, such as `snr^2 / (snr^2 + 50)`.
    #[arg(long, value_name = "FORMULA", allow_hyphen_values = true, conflicts_with_all = ["against", "ellipticity", "step"])]
    weight: Option<String>,
    /// How catalogues belong together [default: recognised from the true shears].
    #[arg(long, value_parser = named::<Design>())]
    design: Option<Design>,
    /// Use only galaxies that count under all test shears. The error of m is then small, and m does not contain how shear
    /// changes which galaxies are selected. Reads each catalogue several times, and keeps the identifiers of one in memory.
    #[arg(long)]
    paired: bool,
    /// Write the sums of the catalogues to this file, for --merge.
    #[arg(long, value_name = "FILE")]
    sums: Option<PathBuf>,
    /// Read only shard K of N of the catalogues.
    #[arg(long, value_name = "K/N", requires = "sums")]
    shard: Option<Shard>,
}

// Split at the last colon, because an expression may contain others in names of columns.
fn parse_bins(text: &str) -> anyhow::Result<Binning> {
    let expected = || {
        anyhow!(
            "expected EXPRESSION:N, EXPRESSION:EDGE,EDGE,... with increasing edges, or EXPRESSION for a bin per value"
        )
    };
    let Some((of, bins)) = text.rsplit_once(':') else {
        return Ok(Binning {
            of: Expression::parse(text)?,
            edges: Edges::Values,
        });
    };
    let of = Expression::parse(of)?;
    let edges = match bins.trim().parse::<usize>() {
        Ok(count) => Edges::equal(count).ok_or_else(|| anyhow!("expected 2 to {MAX_BINS} bins"))?,
        Err(_) => {
            let edges = bins.split(',').map(|text| text.trim().parse().ok());
            let edges: Option<Vec<f64>> = edges.collect();
            edges.and_then(Edges::given).ok_or_else(expected)?
        }
    };
    Ok(Binning { of, edges })
}

// Of a file of sums, which is read into memory. Chosen by hand.
const MAX_BYTES: u64 = 1 << 31;

pub(crate) fn run(arguments: &Arguments, command_line: &str) -> anyhow::Result<()> {
    if let Some(error) = arguments.plan {
        return arguments.printing.print(&plan(error));
    }
    if let Some(folder) = &arguments.example {
        return example(folder);
    }
    let summing = &arguments.summing;
    // Before the catalogues are read, which takes minutes for a survey.
    if let Some(plot) = &arguments.plot {
        PictureFormat::of(plot)?;
    }
    let summed = match arguments.merge.as_slice() {
        [] => of_catalogues(arguments, &listed(&summing.catalogues)?)?,
        files => merged(&listed(files)?)?,
    };
    remember_columns(summed.columns());
    if let Some(path) = &summing.sums {
        atomic::write(path, &serde_json::to_vec(&summed)?)?;
    }
    // A shard may have too few units for errors, or one side of a pair. Its sums are what counts, and they are written.
    let result = match summed.result() {
        // More tasks than catalogues are no fault: `--merge` takes the sums of all.
        Err(BiasFailure::NoGalaxy(total)) if summing.shard.is_some() && total.rows == 0 => {
            let count = summed.absent().len();
            tell(format_args!(
                "note: this shard contains none of the {count} catalogues (expected at most {count} shards); its sums are empty."
            ));
            return Ok(());
        }
        Err(error) if summing.shard.is_some() => {
            tell(format_args!(
                "note: no estimate of this shard alone: {error}"
            ));
            return Ok(());
        }
        // One patch or tile of a survey is a part of the sums like any other, but it passes no limit.
        Err(error @ (BiasFailure::OneUnit(_) | BiasFailure::Bias(BiasError::FewUnits { .. })))
            if summing.sums.is_some() && arguments.fail_above.is_empty() =>
        {
            tell(format_args!(
                "note: no estimate of these sums alone: {error}"
            ));
            return Ok(());
        }
        result => result?,
    };
    if !summing.against.is_empty() {
        let other = of_catalogues(arguments, &listed(&summing.against)?)?;
        let difference = summed.difference(&other)?;
        let other = other.result()?;
        warn(&result);
        let absent = other.about.without_catalogue.iter().cloned();
        let warnings = absent
            .chain(of_design(&other))
            .chain(chosen_by_measurement(&other))
            .chain(of_other_images(&result, &other))
            .chain(of_pairing(&result, &other));
        for warning in warnings {
            tell(format_args!("warning: --against: {warning}"));
        }
        let mut table = compared_table(&result, &other, &difference);
        let checks = check(&difference, &arguments.fail_above);
        if !checks.is_empty() {
            with_failures(&mut table, "bin", &checks);
            table
                .notes
                .push("--fail-above: limits of the rows `difference`.".into());
        }
        arguments.printing.print(&table)?;
        return fail(&checks);
    }
    // The catalogues that a shard lacks are in others.
    if summing.shard.is_none() {
        warn(&result);
    }
    let mut table = bias_table(&result);
    if let Some(area) = arguments.area {
        add_per_area(&mut table, &result, area);
    }
    let checks = check(&result, &arguments.fail_above);
    if !checks.is_empty() {
        with_failures(&mut table, "bin", &checks);
    }
    arguments.printing.check(&table)?;
    if let Some(plot) = &arguments.plot {
        bias_plot(&result).save(plot)?;
    }
    arguments.printing.print(&table)?;
    let sections = || Ok(vec![section(&result, table)?]);
    arguments.report.save("Shear bias", sections, || {
        Ok(made_by([("Command", command_line.to_owned())]))
    })?;
    fail(&checks)
}

fn warn(result: &BiasResult) {
    let warnings = of_design(result).into_iter();
    for warning in warnings.chain(chosen_by_measurement(result)) {
        tell(format_args!("warning: {warning}"));
    }
}

fn fail(checks: &[Checked]) -> anyhow::Result<()> {
    let failed: Vec<_> = checks.iter().filter(|check| check.failed).collect();
    for check in &failed {
        tell(format_args!("error: {}", check.text));
    }
    match failed.is_empty() {
        true => Ok(()),
        false => Err(Findings.into()),
    }
}

/// The sums of a baseline, and the catalogues.
pub(super) fn units(arguments: &Arguments) -> anyhow::Result<(BaselineUnits, Vec<PathBuf>)> {
    let summing = &arguments.summing;
    anyhow::ensure!(
        !summing.catalogues.is_empty() && summing.against.is_empty() && summing.shard.is_none(),
        "bias: a baseline is of catalogues alone. Try: without --against, --shard, --merge, --plan and --example"
    );
    for (option, given, remedy) in [
        (
            "--like",
            summing.like.is_some(),
            "without --like and --tomography: m and c of each bin are compared",
        ),
        (
            "--fail-above",
            !arguments.fail_above.is_empty(),
            "baseline record --tolerance for shifts, and `shearq bias` with --fail-above as a command of its own for limits",
        ),
        (
            "--sums",
            summing.sums.is_some(),
            "without --sums: the baseline has them",
        ),
    ] {
        anyhow::ensure!(
            !given,
            "bias: a baseline cannot be of this option (found {option}). Try: {remedy}"
        );
    }
    let catalogues = listed(&summing.catalogues)?;
    let summed = of_catalogues(arguments, &catalogues)?;
    let result = summed.result()?;
    warn(&result);
    // Folders and tables within files have no fingerprint of one file.
    let files = catalogues.into_iter().filter(|path| path.is_file());
    let files = files.collect();
    Ok((BaselineUnits::Bias(Box::new(summed)), files))
}

fn of_catalogues(arguments: &Arguments, catalogues: &[PathBuf]) -> anyhow::Result<Summed> {
    let (summing, table) = (&arguments.summing, &arguments.reading);
    let specified = summing.truth_sign;
    let mut sign = TrueSign::or_standard(specified);
    let truth = match (&summing.truth, summing.g1.zip(summing.g2)) {
        (Some(path), _) => {
            let (truth, own) = Truth::read(path, specified)?;
            sign = own;
            truth
        }
        (None, Some((g1, g2))) => {
            // Reduced shears of images with positive parity are below 1.
            anyhow::ensure!(
                g1.hypot(g2) < 1.0,
                "--g1, --g2: this is no shear (found {g1} and {g2}, expected a modulus below 1)"
            );
            Truth::Constant([g1, g2])
        }
        (None, None) => Truth::Columns,
    };
    let shard = summing.shard.unwrap_or(Shard::WHOLE);
    let is_open = |bins: &Binning| !matches!(bins.edges, Edges::Given(_));
    let mut of_values = summing.bins.iter().filter(|own| own.edges == Edges::Values);
    if let (Some(_), Some(binning)) = (summing.shard, of_values.next()) {
        let of = binning.of.text();
        anyhow::bail!(
            "--shard: all shards need the same bins (found a bin per value of `{of}`, which a shard may lack). Try: --bins '{of}:0.5,1.5,2.5' for numbers, or for texts sums of each bin with --where \"{of} == 'TEXT'\""
        );
    }
    if summing.shard.is_some() && summing.bins.iter().any(is_open) {
        anyhow::bail!(
            "--shard: all shards need the same bins (found a number of bins, expected edges). Try: --bins 'snr:5,10,20'"
        );
    }
    let selection = selection(summing.condition.as_deref(), summing.weight.as_deref())?;
    if selection.as_ref().is_some_and(|own| own.weights.is_some()) {
        // Catalogues of linear configurations contain shears with responses and no sheared catalogues.
        let unused = [
            ("--against", !summing.against.is_empty()),
            ("--ellipticity", table.ellipticity.is_some()),
            ("--step", table.step.is_some()),
        ];
        if let Some((option, _)) = unused.into_iter().find(|(_, given)| *given) {
            anyhow::bail!("{option}: cannot be used with step() in --where");
        }
    }
    anyhow::ensure!(
        summing.bins.len() <= MAX_AXES,
        "--bins: found {} quantities, expected at most {MAX_AXES}",
        summing.bins.len()
    );
    let found = expand(catalogues, truth)?;
    let request = Request {
        sign,
        bins: summing.bins.clone(),
        like: summing.like.clone().map(|catalogue| Survey {
            catalogue: catalogue.into(),
            tomography: summing.tomography.clone(),
        }),
        paired: summing.paired,
        selection,
        unsheared: summing.unsheared.clone(),
        design: summing.design,
        ..table.request(found)?
    };
    if let Some(name) = request.unused_unsheared() {
        anyhow::bail!("--unsheared: `{name}` is not used (expected a column of --where or --bins)");
    }
    let own = |number: usize| Shard::holding(number, shard.of()) == shard;
    Ok(sum_with_progress(&request, &own, &reading)?)
}

fn merged(files: &[PathBuf]) -> anyhow::Result<Summed> {
    let read = |path: &Path| -> anyhow::Result<Summed> {
        let bytes = open::read(path, MAX_BYTES)
            .with_context(|| format!("{}: cannot read the sums", path.display()))?;
        let what = || format!("{}: these are no sums that --sums wrote", path.display());
        let summed: Summed = serde_json::from_slice(&bytes).with_context(what)?;
        summed.checked().with_context(what)
    };
    // The message names the file that differs from those before it.
    let parts = files.iter().map(|path| Ok((read(path)?, path)));
    let all = joined(parts, |all: &mut (Summed, &PathBuf), (more, path)| {
        let union = all.0.merge(more);
        union.with_context(|| path.display().to_string())
    })?;
    let (all, _) = all.context("--merge: found no files")?;
    // Sums of some shards would give an estimate without a sign that galaxies are missing.
    let absent = all.absent();
    anyhow::ensure!(
        absent.is_empty(),
        "the sums do not contain all catalogues (absent: {}). Try: --merge with the sums of all shards",
        shearq_files::names_of(&absent)
    );
    Ok(all)
}

// Scatter of a component of e over R that remains in the difference between +γ and −γ, and what makes it. Shape noise of
// 0.26 is that of real galaxies at S/N above 20, 0.14 that of GREAT10. The pixel noise of 0.11 is that of `48/linear/star`
// at S/N 20.
const DESIGNS: [(&str, f64, bool); 4] = [
    ("other galaxies at −γ, shape noise 0.26", 0.28, false),
    ("other galaxies at −γ, shape noise 0.14", 0.18, false),
    ("same galaxies, other pixel noise", 0.11, false),
    // Of the relative response alone, so that the difference scatters in proportion to γ. Measured: m1 ± 0.00071 from 100,000
    // measurements at ±0.02 (docs/validate-shapes.md), and the same at ±0.05 and ±0.1.
    ("same galaxies and same pixel noise", 0.22, true),
];
const SHEARS: [(&str, f64); 3] = [("n_02", 0.02), ("n_05", 0.05), ("n_10", 0.1)];

// Errors of m for which a plan is useful: 10⁻⁶ takes 5·10¹⁰ to 2·10¹⁴ measurements.
const PLANNED_ERRORS: RangeInclusive<f64> = 1e-6..=1.0;

fn planned_error(text: &str) -> Result<f64, String> {
    let number = text.parse().ok();
    number
        .filter(|error| PLANNED_ERRORS.contains(error))
        .ok_or_else(|| {
            let (low, high) = (PLANNED_ERRORS.start(), PLANNED_ERRORS.end());
            format!("found `{text}`, expected an error of m from {low:e} to {high}")
        })
}

// How many measurements determine m of a component to `error`: σ(m) = σ/(γ√N), the error of the slope of N points at ±γ.
fn plan(error: f64) -> Table {
    let mut table = Table::titled(format!("Measurements for σ(m) = {error}"));
    table.column("design", "Design", &DESIGNS, |(what, ..)| Cell::text(*what));
    table.column("scatter", "σ", &DESIGNS, |(_, scatter, of_response)| {
        Cell::text(match of_response {
            true => format!("{scatter} γ"),
            false => scatter.to_string(),
        })
    });
    for (key, shear) in SHEARS {
        table.column(
            key,
            format!("γ = {shear}"),
            &DESIGNS,
            |(_, scatter, of_response)| {
                let relative = match of_response {
                    true => *scatter,
                    false => scatter / shear,
                };
                Cell::text(format!("{:.1e}", (relative / error).powi(2)))
            },
        );
    }
    table.notes.push(
        "σ(m) = σ/(γ√N) for N measurements of a component at ±γ; a galaxy under both signs counts twice.".into(),
    );
    table
}

const GALAXIES: usize = 20_000;

// Writes `plus.csv` and `minus.csv`: the same galaxies under (γ, γ) and (−γ, −γ), measured with a known bias.
fn example(folder: &Path) -> anyhow::Result<()> {
    const SHEAR: f64 = 0.02;
    const M: [f64; 2] = [0.01, -0.02];
    const C: [f64; 2] = [0.001, -0.0005];
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (name, shear) in [("plus", SHEAR), ("minus", -SHEAR)] {
        // One stream for galaxies and one for pixel noise, so that both catalogues have the same galaxies.
        let mut galaxies = ChaCha8Rng::seed_from_u64(1);
        let mut noise = ChaCha8Rng::seed_from_u64(if shear > 0.0 { 2 } else { 3 });
        let normal = |random: &mut ChaCha8Rng| -> f64 { StandardNormal.sample(random) };
        let signal_to_noise = Uniform::new(5.0, 50.0)?;
        let mut text = String::from("id,e1,e2,w,R11,R22,snr,flag,g1,g2\n");
        for id in 0..GALAXIES {
            let snr: f64 = signal_to_noise.sample(&mut galaxies);
            let (mut shapes, mut responses) = ([0.0_f64; 2], [0.0_f64; 2]);
            for k in 0..2 {
                responses[k] = 0.8 + 0.1 * normal(&mut galaxies);
                shapes[k] = 0.2 * normal(&mut galaxies)
                    + 0.01 * normal(&mut noise)
                    + responses[k] * ((1.0 + M[k]) * shear + C[k]);
            }
            let [e1, e2] = shapes;
            let [r1, r2] = responses;
            // 2/S/N: about the error of a component. One row in a hundred failed.
            let weight = 1.0 / (0.2_f64.powi(2) + (2.0_f64 / snr).powi(2));
            let flag = u8::from(id % 100 == 0);
            writeln!(
                text,
                "{id},{e1:.6},{e2:.6},{weight:.4},{r1:.5},{r2:.5},{snr:.3},{flag},{shear},{shear}"
            )?;
        }
        atomic::write(folder.join(format!("{name}.csv")), text.as_bytes())?;
    }
    Ok(())
}
