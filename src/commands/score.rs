//! `shearq score`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{ArgGroup, Args};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Grid, Noise, Options, SetScorer, SpectrumScore};
use shearq_submissions::EllipticityType;

use crate::arguments::{
    Printing, ReportFile, ScoreSettings, SetList, SignArgument, Threads, positive,
};
use crate::{print, tell, tell_unread};
use shearq_dataset::fingerprint;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::kind_of;
use shearq_dataset::run::{Run, Source, way};
use shearq_dataset::truth::{ReadTruth, Reading, Sign, read_truth, reading_of};
use shearq_pipeline::PipelineError;
use shearq_render::table::TableFormat;
use shearq_results::foreign::{Foreign, Screen, folder_of, plain_columns};
use shearq_results::row::{Measured, RunRecord, SetRecord};
use shearq_results::score::{COLUMNS, ScoredSet, score_files, score_folder, score_sets, unscored};
use shearq_results::store;
use shearq_results::submit::challenge::{Kind, read_bandpowers};
use shearq_results::submit::manifest::Manifest;
use shearq_results::submit::packed::{Packed, PackedCatalogues, Sent, Submission};
use shearq_results::views::pages;
use shearq_results::views::scores::{SetInput, one_set_json, per_set, spectra, verdict_line};
use shearq_simulate::kinds::SetKind;

/// Score ellipticities against a known shear field: Q, Q_dn, M/2, √A and more.
///
/// Score a folder that `measure` wrote with `--measured OUT`, another program's catalogues with
/// `--data DATA --foreign FILE`, and plain files of one set with `--truth truth.csv CATALOGUE...`.
///
/// Plain files are one catalogue per image: CSV with a header, ASCII `x y e1 e2`, FITS or Parquet, by the file's
/// ending. Their `--format json` lists all eight conventions. Score power spectra with --spectra, and a submission
/// as `pack` writes it with --packed.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("input").required(true).args(["measured", "foreign", "spectra", "packed", "catalogues"]))]
pub(crate) struct Arguments {
    /// Data folder with the true shear [default with --measured: the data that were measured].
    #[arg(long, value_name = "DIR", conflicts_with = "truth")]
    data: Option<PathBuf>,
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR", conflicts_with = "truth")]
    measured: Option<PathBuf>,
    /// Table of the true shear of one set: x, y, g1, g2.
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Catalogues of the set of --truth, one per image.
    #[arg(value_name = "CATALOGUE", requires = "truth", conflicts_with_all = ["data", "sets", "store"])]
    catalogues: Vec<PathBuf>,
    /// Catalogues of another program, described by a TOML file (docs/files-foreign.md).
    #[arg(long, value_name = "FILE", requires = "data", conflicts_with = "truth")]
    foreign: Option<PathBuf>,
    /// Power spectra (`index l power`): a file with --truth, a folder of `{method}_set{set}.dat` with --data.
    #[arg(long, value_name = "PATH", conflicts_with_all = ["noise_var", "convention", "path"])]
    spectra: Option<PathBuf>,
    /// Submission as `pack` writes it: a folder or an archive (.tar.gz) of catalogues or power spectra.
    #[arg(long, value_name = "PATH", requires = "data", conflicts_with_all = ["truth", "path"])]
    packed: Option<PathBuf>,
    /// Sets, such as `1,2,7-9` or `all` [default: all that were measured].
    #[arg(long, value_name = "LIST", conflicts_with = "truth")]
    sets: Option<SetList>,
    /// Noise variance per component, galaxy and image for Q_dn [default: from differences between images].
    #[arg(long, value_name = "V", allow_negative_numbers = true)]
    noise_var: Option<f64>,
    /// Sign of g2 in the file of --truth; data folders state it in layout.toml [default: as the file states, else
    /// the sign in which the shear is an E-mode field, else the sign that e2 follows; required if these are unclear].
    #[arg(long, value_enum, requires = "truth", conflicts_with_all = FOLDERS)]
    truth_sign: Option<SignArgument>,
    /// Pixels per side of a stamp, for --truth [default: 48].
    #[arg(long, value_name = "PX", allow_negative_numbers = true, requires = "truth", conflicts_with_all = FOLDERS)]
    stamp: Option<f64>,
    /// Side of the field in degrees, for --truth [default: 10].
    #[arg(long, value_name = "DEG", requires = "truth", conflicts_with_all = FOLDERS)]
    field: Option<f64>,
    /// Names of the catalogues' columns, or their numbers if they have no names, such as 2,3,4,5; for --truth [default:
    /// x,y,e1,e2].
    #[arg(long, value_name = "X,Y,E1,E2", value_delimiter = ',', num_args = 1, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    columns: Option<Vec<String>>,
    /// Type of the ellipticities, `shear` or `distortion`, for --truth. Distortions are converted to shear-type
    /// ellipticities [default: shear].
    #[arg(long, value_name = "TYPE", value_parser = parse_ellipticity, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    ellipticity: Option<EllipticityType>,
    /// Value of e1 or e2 that marks a galaxy as not measured, such as -99; for --truth.
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    missing: Option<f64>,
    /// Treat galaxies with numbers that stand for a failed measurement, such as -10, -99 or 1e30, as not measured; for
    /// --truth.
    #[arg(long, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    drop_missing: bool,
    /// Treat galaxies with a larger |e| as not measured; for --truth [default: no limit].
    #[arg(long, value_name = "E", value_parser = positive, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    max_modulus: Option<f64>,
    /// Record the scores in this results store, for `compare --store`.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["truth", "spectra"])]
    store: Option<PathBuf>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    report: ReportFile,
    #[command(flatten)]
    settings: ScoreSettings,
    #[command(flatten)]
    threads: Threads,
}

/// Options of input with a data folder. Its layout specifies the sign of g2, the stamps and the field.
const FOLDERS: [&str; 6] = ["data", "measured", "foreign", "packed", "sets", "store"];
/// Options of input other than plain catalogues.
const NOT_PLAIN: [&str; 7] = [
    "data", "measured", "foreign", "packed", "spectra", "sets", "store",
];

fn parse_ellipticity(text: &str) -> Result<EllipticityType, String> {
    match text {
        "shear" => Ok(EllipticityType::Shear),
        "distortion" => Ok(EllipticityType::Distortion),
        _ => Err("expected `shear` or `distortion`".into()),
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let options = Options {
        definition: arguments.settings.definition(),
        noise: arguments.noise_var.map_or(Noise::Measured, Noise::Given),
        choice: match arguments.measured {
            Some(_) => arguments.settings.own_choice(),
            None => arguments.settings.choice(),
        },
    };
    let data = arguments.data.as_ref().map(DataFolder::open).transpose()?;
    if let (Some(path), Some(data)) = (&arguments.packed, &data) {
        return packed(arguments, data, path, options);
    }
    match (&arguments.truth, &arguments.spectra, data) {
        (Some(truth), Some(spectrum), _) => spectrum_file(arguments, truth, spectrum, options),
        (Some(truth), None, _) => files(arguments, truth, options),
        (None, Some(spectra), Some(data)) => spectrum_folder(arguments, &data, spectra, options),
        (None, Some(_), None) => {
            bail!("--spectra needs the true shear. Try: --data DIR, or --truth FILE")
        }
        (None, None, data) => folder(arguments, data, options),
    }
}

fn folder(arguments: &Arguments, data: Option<DataFolder>, options: Options) -> anyhow::Result<()> {
    let store = arguments.store.as_deref();
    let _prepared = store.map(store::prepare).transpose()?;
    let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
    let threads = arguments.threads.number();
    let (name, made_by, scored, unscored) = match (&arguments.measured, &arguments.foreign, data) {
        (Some(measured), _, data) => {
            let run = Run::require(measured)?;
            let data = data.map_or_else(|| run.source.data(measured), Ok)?;
            let scored = score_folder(&data, measured, &run, sets, options, threads)?;
            if let Some(store) = &arguments.store {
                let made = Measured::run(&run, &data, measured)?;
                record_printable(arguments, store, made, &scored, options)?;
            }
            let unscored = unscored(&data, &scored, sets)?;
            let made_by = made_by(&run, measured)?;
            (run.configuration.name, made_by, scored, unscored)
        }
        (None, Some(path), Some(data)) => {
            let foreign = Foreign::read(path)?;
            let read = |grid: &Grid, path: &Path| foreign.sum(grid, path);
            let files = foreign.catalogues(sets)?;
            anyhow::ensure!(
                !files.serve_all_sets() || !sets.is_empty(),
                "{}: cannot determine the sets, because `catalogues` contains no {{set}}. Try: --sets 1",
                path.display()
            );
            tell_unread(&files);
            let catalogues = |set| files.of_set(set);
            let scored = score_sets(&data, sets, catalogues, &read, options, threads)
                .with_context(|| path.display().to_string())?;
            if let Some(store) = &arguments.store {
                let made = Measured {
                    name: &foreign.name,
                    settings: shearq_files::open::read_to_string(
                        path,
                        shearq_files::open::SETTINGS,
                    )
                    .with_context(|| path.display().to_string())?,
                    source: &Source::folder(&data, folder_of(path))?,
                    data: &data,
                };
                record_printable(arguments, store, made, &scored, options)?;
            }
            let unscored = unscored(&data, &scored, sets)?;
            let made_by = [("Catalogues", path.as_path()), ("Data", data.root())]
                .map(|(what, path)| (what.to_owned(), path.display().to_string()));
            (foreign.name.clone(), made_by.into(), scored, unscored)
        }
        (None, _, _) => bail!("--foreign needs the true shear. Try: --data DIR"),
    };
    let title = format!("Scores of {name}");
    let mut table = per_set(&scored, &title, options.definition);
    table.notes.extend(unscored);
    table.notes.extend(verdict_line(&name, &scored));
    arguments.printing.print(&table)?;
    let sections = || Ok(vec![pages::scores(&name, &scored, table)?]);
    arguments.report.save(&title, sections, || Ok(made_by))
}

/// Records scores after checking that they can be printed, so that a failing command records nothing.
fn record_printable(
    arguments: &Arguments,
    store: &Path,
    measured: Measured<'_>,
    scored: &[ScoredSet],
    options: Options,
) -> anyhow::Result<()> {
    let table = per_set(scored, "", options.definition);
    arguments.printing.check(&table)?;
    record(store, measured, scored, options)
}

/// Source and settings of a run, for reports.
pub(super) fn made_by(run: &Run, out: &Path) -> anyhow::Result<Vec<(String, String)>> {
    Ok(vec![
        ("Catalogues".into(), out.display().to_string()),
        ("Source".into(), serde_json::to_string(&run.source)?),
        (
            run.configuration.name.clone(),
            toml::to_string(&run.configuration)?,
        ),
    ])
}

/// Records a scored run in a results store and prints the file name.
pub(super) fn record(
    store: &Path,
    measured: Measured<'_>,
    scored: &[ScoredSet],
    options: Options,
) -> anyhow::Result<()> {
    let path = store::write(store, &RunRecord::new(measured, scored, options)?)?;
    tell(format_args!("recorded in {}", path.display()));
    Ok(())
}

/// Scores a submission.
fn packed(
    arguments: &Arguments,
    data: &DataFolder,
    path: &Path,
    options: Options,
) -> anyhow::Result<()> {
    let _prepared = arguments.store.as_deref().map(store::prepare).transpose()?;
    let sent = Sent::open(path)?;
    let submission = Submission::read(&sent)?;
    let Packed::Spectra(files) = submission.packed else {
        let catalogues = PackedCatalogues::new(sent, submission)?;
        return packed_catalogues(arguments, data, path, &catalogues, options);
    };
    anyhow::ensure!(
        arguments.noise_var.is_none(),
        "--noise-var applies to catalogues only; {} contains power spectra. Try: without --noise-var",
        path.display()
    );
    let named = |error: anyhow::Error| {
        let named = |error| sent.named(error).into();
        error.downcast().map_or_else(|other| other, named)
    };
    let manifest = submission.manifest.as_ref();
    let scored = score_spectra(arguments, data, files, manifest, path, options).map_err(named)?;
    print_spectra(arguments, &scored, |set| kind_of(data, set), path, options)?;
    let Some(store) = &arguments.store else {
        return Ok(());
    };
    let made = packed_made_by(&submission.method, manifest, path, data)?;
    let source = Source::folder(data, folder_of(path))?;
    let mut sets = Vec::new();
    for (set, score) in &scored {
        let Some(set) = *set else { continue };
        // The images that the spectrum was made from are not recorded.
        let print = fingerprint::of_set(&source, data, set, &[])?;
        let simulated = kind_of(data, set).is_some();
        sets.push(SetRecord::of_spectrum(
            set,
            simulated,
            score,
            Vec::new(),
            print,
        ));
    }
    let run = RunRecord::of_records(made.measured(&source, data), sets, options)?;
    let path = store::write(store, &run)?;
    tell(format_args!("recorded in {}", path.display()));
    Ok(())
}

/// Name and settings of a submission, for a store.
struct PackedBy {
    name: String,
    settings: String,
}

impl PackedBy {
    fn measured<'a>(&'a self, source: &'a Source, data: &'a DataFolder) -> Measured<'a> {
        Measured {
            name: &self.name,
            settings: self.settings.clone(),
            source,
            data,
        }
    }
}

fn packed_made_by(
    method: &str,
    manifest: Option<&Manifest>,
    path: &Path,
    data: &DataFolder,
) -> anyhow::Result<PackedBy> {
    let run = manifest.and_then(|manifest| manifest.run.as_ref());
    Ok(PackedBy {
        name: method.to_owned(),
        settings: match run {
            Some(run) => toml::to_string(&run.configuration)?,
            // The path from the data to the submission distinguishes methods of one name.
            None => way(data.root(), path)?.display().to_string(),
        },
    })
}

/// Scores the catalogues of a submission.
fn packed_catalogues(
    arguments: &Arguments,
    data: &DataFolder,
    path: &Path,
    catalogues: &PackedCatalogues,
    options: Options,
) -> anyhow::Result<()> {
    let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
    let options = Options {
        choice: match catalogues.is_own() {
            true => arguments.settings.own_choice(),
            false => arguments.settings.choice(),
        },
        ..options
    };
    let read = |grid: &Grid, path: &Path| catalogues.sum(grid, path);
    let threads = arguments.threads.number();
    let of_set = |set| catalogues.of_set(set);
    let mut scored =
        score_sets(data, sets, of_set, &read, options, threads).map_err(|error| match error {
            PipelineError::File(error) => catalogues.sent.named(error).into(),
            other => other,
        })?;
    for set in &mut scored {
        set.odd_images
            .renamed(|path| catalogues.sent.as_given(path));
    }
    if let Some(store) = &arguments.store {
        let manifest = catalogues.manifest.as_ref();
        let made = packed_made_by(&catalogues.method, manifest, path, data)?;
        let source = Source::folder(data, folder_of(path))?;
        record_printable(
            arguments,
            store,
            made.measured(&source, data),
            &scored,
            options,
        )?;
    }
    let title = format!("Scores of {}", catalogues.method);
    let mut table = per_set(&scored, &title, options.definition);
    table.notes.extend(unscored(data, &scored, sets)?);
    table
        .notes
        .extend(verdict_line(&catalogues.method, &scored));
    arguments.printing.print(&table)
}

/// Scores the power spectra of a folder, one file per set.
fn spectrum_folder(
    arguments: &Arguments,
    data: &DataFolder,
    folder: &Path,
    options: Options,
) -> anyhow::Result<()> {
    let mut files = BTreeMap::<u32, PathBuf>::new();
    let cannot_read = || format!("{}: cannot read the folder", folder.display());
    for entry in std::fs::read_dir(folder).with_context(cannot_read)? {
        let path = entry.with_context(cannot_read)?.path();
        let Some(Kind::Spectrum { set, .. }) = Kind::of(&path) else {
            continue;
        };
        if let Some(other) = files.insert(set, path.clone()) {
            bail!(
                "{}: {} is also a spectrum of set {set}; expected one method",
                path.display(),
                other.display()
            );
        }
    }
    anyhow::ensure!(
        !files.is_empty(),
        "{}: found no file named {{method}}_set{{set}}.dat",
        folder.display()
    );
    let manifest = Manifest::read(folder)?;
    let scored = score_spectra(arguments, data, files, manifest.as_ref(), folder, options)?;
    print_spectra(
        arguments,
        &scored,
        |set| kind_of(data, set),
        folder,
        options,
    )
}

/// Scores the power spectra `files` by set, of the submission at `place`.
fn score_spectra(
    arguments: &Arguments,
    data: &DataFolder,
    mut files: BTreeMap<u32, PathBuf>,
    manifest: Option<&Manifest>,
    place: &Path,
    options: Options,
) -> anyhow::Result<Vec<(Option<u32>, SpectrumScore)>> {
    if let Some(wanted) = &arguments.sets {
        if let Some(set) = wanted.0.iter().find(|set| !files.contains_key(set)) {
            bail!("{}: found no spectrum of set {set}", place.display());
        }
        files.retain(|set, _| wanted.0.contains(set));
    }
    let mut scored = Vec::new();
    for (set, path) in &files {
        let truth = read_truth(&data.truth(*set), &reading_of(data, *set)?)?;
        let score = score_spectrum(truth, path, manifest, options)?;
        scored.push((Some(*set), score));
    }
    Ok(scored)
}

fn spectrum_file(
    arguments: &Arguments,
    path: &Path,
    spectrum: &Path,
    options: Options,
) -> anyhow::Result<()> {
    let truth = read_truth(path, &plain_reading(arguments))?;
    // Power spectra do not contain the sign of e2.
    if truth.sign.is_none() {
        let unknown = Sign::of_catalogues(None).map_err(anyhow::Error::msg);
        unknown.with_context(|| path.display().to_string())?;
    }
    let manifest = Manifest::read(folder_of(spectrum))?;
    let line = truth.sign.and_then(Sign::line);
    let score = score_spectrum(truth, spectrum, manifest.as_ref(), options)?;
    if let Some(line) = line {
        tell(format_args!("{line}"));
    }
    let scored = [(None, score)];
    print_spectra(arguments, &scored, |_| None, spectrum, options)
}

fn score_spectrum(
    truth: ReadTruth,
    path: &Path,
    manifest: Option<&Manifest>,
    options: Options,
) -> anyhow::Result<SpectrumScore> {
    let ReadTruth { grid, shear, .. } = truth;
    let powers = read_bandpowers(path, &grid)?;
    let covariance = manifest.and_then(|manifest| {
        let name = path.file_name()?.to_str()?;
        manifest.covariances.get(name)
    });
    Ok(SetScorer::new(grid, shear, options)?.score_spectrum(&powers, covariance)?)
}

fn print_spectra(
    arguments: &Arguments,
    scored: &[(Option<u32>, SpectrumScore)],
    kind_of: impl Fn(u32) -> Option<SetKind>,
    path: &Path,
    options: Options,
) -> anyhow::Result<()> {
    let title = format!("Scores of the power spectra of {}", path.display());
    let table = spectra(scored, kind_of, &title, options.definition);
    arguments.printing.print(&table)
}

/// How to read the file of `--truth`.
fn plain_reading(arguments: &Arguments) -> Reading {
    Reading {
        field: Degrees(arguments.field.unwrap_or(10.0)),
        stamp: Pixels(arguments.stamp.unwrap_or(48.0)),
        sign: arguments.truth_sign.map(Into::into),
    }
}

fn files(arguments: &Arguments, truth: &Path, options: Options) -> anyhow::Result<()> {
    let columns = arguments.columns.as_deref();
    let columns: Vec<&str> = columns.map_or_else(
        || COLUMNS.to_vec(),
        |given| given.iter().map(String::as_str).collect(),
    );
    let columns: [&str; 4] = columns.as_slice().try_into().map_err(|_| {
        anyhow::anyhow!(
            "--columns: wrong number of columns (found {}, expected 4: x, y, e1 and e2)",
            columns.len()
        )
    })?;
    let screen = Screen {
        missing: arguments.missing,
        drop_missing: arguments.drop_missing,
        max_modulus: arguments.max_modulus,
        distortion: arguments.ellipticity == Some(EllipticityType::Distortion),
    };
    let mut seen = BTreeSet::new();
    for path in &arguments.catalogues {
        let same = path.canonicalize().unwrap_or_else(|_| path.clone());
        anyhow::ensure!(
            seen.insert(same),
            "{}: this catalogue is given twice; expected one per image",
            path.display()
        );
    }
    let scored = score_files(
        truth,
        &arguments.catalogues,
        &plain_reading(arguments),
        &plain_columns(columns, screen),
        options,
        arguments.threads.number(),
    )?;
    let title = format!("Scores against {}", truth.display());
    let scored = [scored];
    let mut table = per_set(&scored, &title, options.definition);
    table.notes.extend(verdict_line("The catalogues", &scored));
    if arguments.printing.format() == TableFormat::Json {
        anyhow::ensure!(
            !arguments.printing.chooses(),
            "--metrics: JSON of plain files always has all metrics. Try: --format csv"
        );
        let name = |path: &Path| path.display().to_string();
        let input = SetInput {
            case: truth
                .parent()
                .and_then(|folder| folder.file_name())
                .map_or_else(|| name(truth), |n| n.to_string_lossy().into_owned()),
            truth: name(truth),
            catalogues: arguments.catalogues.iter().map(|path| name(path)).collect(),
            definition: options.definition,
        };
        let mut text = serde_json::to_string_pretty(&one_set_json(&scored[0], &input))?;
        text.push('\n');
        print(&text)?;
    } else {
        arguments.printing.print(&table)?;
    }
    let mut made_by = vec![("Truth".to_owned(), truth.display().to_string())];
    made_by.extend(
        arguments
            .catalogues
            .iter()
            .enumerate()
            .map(|(k, path)| (format!("Catalogue {}", k + 1), path.display().to_string())),
    );
    let sections = || Ok(vec![pages::scores("catalogues", &scored, table)?]);
    arguments.report.save(&title, sections, || Ok(made_by))
}
