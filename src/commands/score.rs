use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{ArgGroup, Args};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Noise, Options, SetScorer, TruthSign};

use crate::arguments::{
    Printing, ReportFile, ScoreSettings, SetList, Threads, named, positive, sets_of, split_columns,
};
use crate::origin::remember_columns;
use crate::{print_json, tell, tell_notes, tell_unread};
use shearq_catalogue::columns::Shapes;
use shearq_catalogue::foreign::Foreign;
use shearq_catalogue::recognition::read_presets;
use shearq_challenges::{PublicChallenge, Truth};
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source, kind_of};
use shearq_dataset::threads::Pool;
use shearq_dataset::truth::{ReadTruth, Reading, read_truth, reading_of};
use shearq_files::FileError;
use shearq_files::atomic::folder_of;
use shearq_render::table::TableFormat;
use shearq_results::baseline::catalogues::{ScoredUnits, Units};
use shearq_results::catalogues::Catalogues;
use shearq_results::record::{RunRecord, SetRecord};
use shearq_results::score::{ScoredSet, score_catalogues, score_files, unscored};
use shearq_results::submit::{Packed, Sent, Submission, read_bandpowers};
use shearq_results::views::comparison::verdict_line;
use shearq_results::views::pages;
use shearq_results::views::scores::{SetInput, notes, one_set_json, per_set, spectra};
use shearq_results::{aperture, store};

/// Score ellipticities against a known shear field: Q, Q_dn, M/2, √A and more.
///
/// Score a folder that `measure` wrote with `--measured OUT`, another program's catalogues with
/// `--data DATA --foreign FILE`, and plain files of one set with `--truth truth.csv CATALOGUE...`.
///
/// Plain files are one catalogue per image: text, FITS or Parquet, recognised by their first bytes. Their
/// `--format json` lists all eight conventions. Score a submission as `pack` writes it, of catalogues or power
/// spectra, with --packed, and a submission to GREAT3 or GREAT08 with --challenge (docs/great3.md).
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("input").required(true).args(["measured", "foreign", "packed", "catalogues"]))]
pub(crate) struct Arguments {
    /// Data folder with the true shear [default with --measured: the data that were measured].
    #[arg(long, value_name = "DIR", conflicts_with = "truth")]
    data: Option<PathBuf>,
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR", conflicts_with = "truth")]
    measured: Option<PathBuf>,
    /// Table of the true shear of one set: x, y, g1, g2. With --challenge: table of the truth, or folder of the files that
    /// the organisers released.
    #[arg(long, value_name = "PATH")]
    truth: Option<PathBuf>,
    /// Catalogues of the set of --truth, one per image.
    #[arg(value_name = "CATALOGUE", requires = "truth", conflicts_with_all = ["data", "sets", "store"])]
    catalogues: Vec<PathBuf>,
    /// Catalogues of another program, described by a TOML file (docs/files.md).
    #[arg(long, value_name = "FILE", requires = "data", conflicts_with = "truth")]
    foreign: Option<PathBuf>,
    /// Submission as `pack` writes it: a folder or an archive (.tar.gz) of catalogues or power spectra.
    #[arg(long, value_name = "PATH", requires = "data", conflicts_with_all = ["truth", "report"])]
    packed: Option<PathBuf>,
    /// Sets, such as `1,2,7-9` or `all` [default: all that were measured].
    #[arg(long, value_name = "LIST", conflicts_with = "truth")]
    sets: Option<SetList>,
    /// Noise variance per component, galaxy and image for Q_dn [default: from differences between images].
    #[arg(long, value_name = "V", allow_hyphen_values = true)]
    noise_var: Option<f64>,
    /// Sign of g2 in the file of --truth; data folders state it in layout.toml [default: as the file states, else
    /// the sign in which the shear is an E-mode field, else the sign with which e2 correlates at 5σ; required if these are unclear].
    #[arg(long, value_parser = named::<TruthSign>(), requires = "truth", conflicts_with_all = NOT_PLAIN)]
    truth_sign: Option<TruthSign>,
    /// Pixels per side of a stamp, for --truth [default: 48].
    #[arg(long, value_name = "PX", allow_hyphen_values = true, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    stamp: Option<f64>,
    /// Side of the field in degrees, for --truth [default: 10].
    #[arg(long, value_name = "DEG", requires = "truth", conflicts_with_all = NOT_PLAIN)]
    field: Option<f64>,
    /// Columns of the catalogues, for --truth: by role as in `bias`, such as `e1=g_1,e2=g_2,w=none`, or x, y, e1 and e2 in this
    /// order; by number if they have no names, such as 2,3,4,5 [default: recognised; without names x,y,e1,e2].
    #[arg(long, value_name = "ROLE=COLUMN|X,Y,E1,E2", num_args = 1, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    columns: Vec<String>,
    /// Also recognise the surveys that this file describes, as in `bias`; for --truth.
    #[arg(long, value_name = "FILE", requires = "truth", conflicts_with_all = NOT_PLAIN)]
    preset: Vec<PathBuf>,
    /// Type of the ellipticities, for --truth [default: by their columns, as in `bias`].
    #[arg(long, value_name = "TYPE", value_parser = named::<Shapes>(), requires = "truth", conflicts_with_all = NOT_PLAIN)]
    ellipticity: Option<Shapes>,
    /// Value of e1 or e2 that marks a galaxy as not measured, such as -99; for --truth.
    #[arg(long, value_name = "VALUE", allow_hyphen_values = true, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    missing: Option<f64>,
    /// Treat galaxies with numbers that stand for a failed measurement, such as -10, -99 or 1e30, as not measured; for
    /// --truth.
    #[arg(long, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    drop_missing: bool,
    /// Treat galaxies with a larger |e| as not measured; for --truth [default: no limit].
    #[arg(long, value_name = "E", value_parser = positive, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    max_modulus: Option<f64>,
    /// Artificial shear of metacalibration, for --truth [default: 0.01].
    #[arg(long, value_name = "G", value_parser = positive, requires = "truth", conflicts_with_all = NOT_PLAIN)]
    step: Option<f64>,
    /// Print the aperture mass dispersion of the catalogues and of the true shear instead of scores.
    #[arg(long, conflicts_with_all = ["packed", "store", "report", "noise_var", "definition", "challenge", "branch", "psf", "subfields"])]
    aperture_mass: bool,
    /// Score a submission to this challenge: great3, great08.
    #[arg(long, value_name = "NAME", requires = "truth", conflicts_with_all = GREAT10_ONLY)]
    challenge: Option<String>,
    /// Branch of the challenge, such as control-ground-constant.
    #[arg(long, value_name = "NAME", requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    branch: Option<String>,
    /// Table of the ellipticities of the PSF, `subfield epoch psf_g1 psf_g2`, for branches of GREAT3 with constant shear
    /// [default: starshape_parameters-* in the folder of --truth].
    #[arg(long, value_name = "PATH", requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    psf: Option<PathBuf>,
    /// Subfields of a branch of GREAT3 that was simulated [default: 200].
    #[arg(long, value_name = "N", requires = "branch", conflicts_with_all = GREAT10_ONLY, value_parser = clap::value_parser!(u16).range(1..=1000))]
    subfields: Option<u16>,
    /// Record the scores in this results store, for `compare --store`.
    #[arg(long, value_name = "DIR", conflicts_with = "truth")]
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

// Inputs with a data folder, whose layout specifies the sign of g2, the stamps and the field, and with a record or a description of
// columns, type and missing values: options for these could contradict them.
const NOT_PLAIN: [&str; 6] = ["data", "measured", "foreign", "packed", "sets", "store"];

// Options without a meaning for submissions to other challenges.
const GREAT10_ONLY: [&str; 21] = [
    "data",
    "measured",
    "foreign",
    "packed",
    "sets",
    "noise_var",
    "truth_sign",
    "stamp",
    "field",
    "columns",
    "preset",
    "ellipticity",
    "missing",
    "drop_missing",
    "max_modulus",
    "step",
    "store",
    "wide",
    "metrics",
    "definition",
    "convention",
];

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let (Some(challenge), Some(truth)) = (&arguments.challenge, &arguments.truth) {
        let branch = PublicChallenge::named(challenge)?.branch(arguments.branch.as_deref())?;
        let truth = Truth {
            path: truth,
            psf: arguments.psf.as_deref(),
            subfields: arguments.subfields.map(usize::from),
        };
        let [submission] = arguments.catalogues.as_slice() else {
            bail!(
                "--challenge: found {} submissions, expected one",
                arguments.catalogues.len()
            );
        };
        let shown = submission.display();
        let score = branch.score(truth, submission, &Pool::new(arguments.threads.number())?)?;
        for warning in score.refusal.iter().chain(&score.warnings) {
            tell(format_args!("warning: {shown}: {warning}"));
        }
        let title = format!("{}: {shown}", branch.title());
        match arguments.printing.format() {
            // One object with the challenge's names, not the rows of a table.
            TableFormat::Json => print_json(score.json())?,
            _ => arguments.printing.print(&score.table(title.clone()))?,
        }
        let made_by = [("Truth", truth.path), ("Submission", submission)];
        let made_by = made_by.map(|(what, path)| (what.to_owned(), path.display().to_string()));
        let sections = || Ok(vec![score.section(&title)?]);
        return arguments
            .report
            .save(&title, sections, || Ok(made_by.into()));
    }
    let options = options_of(arguments);
    let data = arguments.data.as_ref().map(DataFolder::open).transpose()?;
    match &arguments.truth {
        Some(truth) => files(arguments, truth, options),
        None => catalogues(arguments, data, options),
    }
}

/// What the columns of catalogues are used as. They become part of the origin.
pub(super) fn account(catalogues: &Catalogues) -> Result<Vec<String>, FileError> {
    remember_columns(catalogues.columns()?);
    catalogues.account()
}

fn options_of(arguments: &Arguments) -> Options {
    Options {
        definition: arguments.settings.definition,
        noise: arguments.noise_var.map_or(Noise::Measured, Noise::Given),
        choice: arguments.settings.convention.unwrap_or_default(),
    }
}

// Catalogues of shearq have the standard convention. That of other programs is determined from the data.
fn options_for(arguments: &Arguments, catalogues: &Catalogues, options: Options) -> Options {
    let stated = arguments.settings.convention;
    Options {
        choice: stated.unwrap_or(catalogues.choice()),
        ..options
    }
}

/// The scored sets of a baseline, and the catalogues.
pub(super) fn units(arguments: &Arguments) -> anyhow::Result<(Units, Vec<PathBuf>)> {
    anyhow::ensure!(
        arguments.challenge.is_none() && arguments.store.is_none() && !arguments.aperture_mass,
        "score: a baseline is of catalogues of a set. Try: without --challenge, --store and --aperture-mass"
    );
    let options = options_of(arguments);
    let of = |scored: &[ScoredSet], truth: &dyn Fn(u32) -> PathBuf| -> anyhow::Result<_> {
        for note in notes(scored) {
            if note.starts_with("warning: ") {
                tell(format_args!("{note}"));
            }
        }
        let units = scored
            .iter()
            .map(|own| ScoredUnits::new(own, &truth(own.record.set)));
        Ok(Units::Score(units.collect::<Result<_, _>>()?))
    };
    if let Some(truth) = &arguments.truth {
        let (catalogues, _, scored) = scored_files(arguments, truth, options)?;
        tell_notes(account(&catalogues)?);
        return Ok((
            of(&scored, &|_| truth.clone())?,
            arguments.catalogues.clone(),
        ));
    }
    let data = arguments.data.as_ref().map(DataFolder::open).transpose()?;
    let Found::Catalogues(catalogues, data) = found(arguments, data)? else {
        bail!("score: a baseline is of catalogues (found power spectra)");
    };
    let (scored, _) = scored_catalogues(arguments, &catalogues, &data, options)?;
    tell_notes(account(&catalogues)?);
    let of_set = |own: &ScoredSet| catalogues.files.of_set(own.record.set);
    // Files of an archive are in a temporary folder.
    let files = match &arguments.packed {
        Some(path) => Vec::from_iter(path.is_file().then(|| path.clone())),
        None => scored
            .iter()
            .flat_map(of_set)
            .map(|(_, path)| path)
            .collect(),
    };
    Ok((of(&scored, &|set| data.truth(set))?, files))
}

enum Found {
    Catalogues(Box<Catalogues>, DataFolder),
    Spectra(Sent, Box<Submission>, DataFolder),
}

fn found(arguments: &Arguments, data: Option<DataFolder>) -> anyhow::Result<Found> {
    let sets = sets_of(arguments.sets.as_ref());
    let (catalogues, data) = match (&arguments.measured, &arguments.foreign, data) {
        (Some(folder), _, data) => {
            let run = Run::require(folder)?;
            let data = data.map_or_else(|| run.source.data(folder), Ok)?;
            (Catalogues::measured(&run, folder, sets)?, data)
        }
        (None, Some(path), Some(data)) => {
            let catalogues = Catalogues::foreign(path, sets)?;
            anyhow::ensure!(
                !catalogues.files.serve_all_sets() || !sets.is_empty(),
                "{}: cannot determine the sets, because `catalogues` contains no {{set}}. Try: --sets 1",
                path.display()
            );
            tell_unread(catalogues.files.unread());
            (catalogues, data)
        }
        (None, None, Some(data)) => {
            let path = arguments.packed.as_deref();
            let path = path.context("--packed: expected a folder or an archive")?;
            let sent = Sent::open(path)?;
            let submission = Submission::read(&sent)?;
            if let Packed::Spectra(_) = &submission.packed {
                return Ok(Found::Spectra(sent, Box::new(submission), data));
            }
            (Catalogues::packed(sent, submission, &data)?, data)
        }
        (None, _, None) => unreachable!("clap requires --data"),
    };
    Ok(Found::Catalogues(Box::new(catalogues), data))
}

// Also the options with the convention of the catalogues.
fn scored_catalogues(
    arguments: &Arguments,
    catalogues: &Catalogues,
    data: &DataFolder,
    options: Options,
) -> anyhow::Result<(Vec<ScoredSet>, Options)> {
    let sets = sets_of(arguments.sets.as_ref());
    let options = options_for(arguments, catalogues, options);
    let scored = score_catalogues(data, catalogues, sets, options, arguments.threads.number());
    let scored = match &catalogues.description {
        // The cause of an error in a catalogue may be its description, so the message names both.
        Some(own) if !own.name.is_empty() => {
            scored.with_context(|| catalogues.path.display().to_string())?
        }
        _ => scored?,
    };
    Ok((scored, options))
}

fn catalogues(
    arguments: &Arguments,
    data: Option<DataFolder>,
    options: Options,
) -> anyhow::Result<()> {
    let store = arguments.store.as_deref();
    // Before scoring: a store that cannot be written is an error at once.
    let _prepared = store.map(store::prepare).transpose()?;
    let sets = sets_of(arguments.sets.as_ref());
    let (catalogues, data) = match found(arguments, data)? {
        Found::Catalogues(catalogues, data) => (catalogues, data),
        Found::Spectra(sent, submission, data) => {
            return packed_spectra(arguments, &data, &sent, &submission, options);
        }
    };
    let (scored, options) = scored_catalogues(arguments, &catalogues, &data, options)?;
    let name = &catalogues.name;
    if arguments.aperture_mass {
        let truth = |set: u32| read_truth(&data.truth(set), &reading_of(&data, set)?);
        let threads = arguments.threads.number();
        let masses = aperture::masses(&catalogues, &scored, truth, threads)?;
        let title = format!("Aperture masses of {name}");
        return arguments.printing.print(&aperture::table(title, &masses));
    }
    let title = format!("Scores of {name}");
    let mut table = per_set(&scored, &title, options.definition);
    table.notes.extend(account(&catalogues)?);
    table.notes.extend(unscored(&data, &scored, sets)?);
    table.notes.extend(verdict_line(name, &scored));
    if let Some(store) = store {
        // Before recording, so that a wrong --metrics leaves no run in the store.
        arguments.printing.check(&table)?;
        record(store, &catalogues, &data, &scored, options)?;
    }
    arguments.printing.print(&table)?;
    let sections = || Ok(vec![pages::scores(name, &scored, table)?]);
    arguments
        .report
        .save(&title, sections, || match &catalogues.run {
            Some(run) => made_by(run, &catalogues.path),
            None => Ok([("Catalogues", &*catalogues.path), ("Data", data.root())]
                .map(|(what, path)| (what.to_owned(), path.display().to_string()))
                .into()),
        })
}

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

pub(super) fn record(
    store: &Path,
    catalogues: &Catalogues,
    data: &DataFolder,
    scored: &[ScoredSet],
    options: Options,
) -> anyhow::Result<()> {
    let sets = scored.iter().map(|set| set.record.clone()).collect();
    let Catalogues { name, settings, .. } = catalogues;
    let run = RunRecord::new(name, settings, String::new(), options, sets);
    write_record(store, run, &catalogues.source(data)?, data)
}

fn write_record(
    store: &Path,
    run: RunRecord,
    source: &Source,
    data: &DataFolder,
) -> anyhow::Result<()> {
    let path = store::write(store, &run.with_fingerprints(source, data)?)?;
    tell(format_args!("recorded in {}", path.display()));
    Ok(())
}

fn packed_spectra(
    arguments: &Arguments,
    data: &DataFolder,
    sent: &Sent,
    submission: &Submission,
    options: Options,
) -> anyhow::Result<()> {
    let Packed::Spectra(files) = &submission.packed else {
        unreachable!("the caller distinguishes them");
    };
    let mut files = files.clone();
    let path = sent.as_given(sent.path());
    anyhow::ensure!(
        arguments.noise_var.is_none(),
        "--noise-var applies to catalogues only; {} contains power spectra. Try: without --noise-var",
        path.display()
    );
    if let wanted @ [_, ..] = sets_of(arguments.sets.as_ref()) {
        if let Some(set) = wanted.iter().find(|set| !files.contains_key(set)) {
            bail!("{}: found no spectrum of set {set}", path.display());
        }
        // Spectra of other sets are not read: a damaged one must not stop the chosen sets.
        files.retain(|set, _| wanted.contains(set));
    }
    let manifest = submission.manifest.as_ref();
    // Of zeros, Q is the value that a method without any signal reaches.
    let (mut records, mut of_zeros) = (Vec::new(), Vec::new());
    for (set, file) in files {
        let ReadTruth { grid, shear, .. } = read_truth(&data.truth(set), &reading_of(data, set)?)?;
        // An archive is unpacked to a temporary folder, whose name means nothing to users.
        let powers = read_bandpowers(&file, &grid).map_err(|error| sent.named(error))?;
        // A bandpower alone has no error. `pack` stores the covariance of cross-spectra from eight images on.
        let covariance =
            manifest.and_then(|manifest| manifest.covariances.get(file.file_name()?.to_str()?));
        let score = SetScorer::new(grid, shear, options)?.score_spectrum(&powers, covariance)?;
        let simulated = kind_of(data, set)?.is_some();
        records.push(SetRecord::of_spectrum(set, simulated, Vec::new(), &score));
        of_zeros.push(score.zero_q);
    }
    let title = format!("Scores of the power spectra of {}", path.display());
    let table = spectra(&records, &of_zeros, &title, options.definition);
    arguments.printing.print(&table)?;
    let Some(store) = &arguments.store else {
        return Ok(());
    };
    let settings = submission.settings(&path, data)?;
    // The images that the spectra were made from are not recorded, so that differences cannot be paired.
    let name = &submission.method;
    let run = RunRecord::new(name, &settings, String::new(), options, records);
    write_record(store, run, &Source::folder(data, folder_of(&path))?, data)
}

// What the user states of plain files.
fn described(arguments: &Arguments) -> anyhow::Result<Option<Foreign>> {
    let mut columns = BTreeMap::new();
    let given = split_columns(&arguments.columns);
    let by_role = given.iter().any(|own| own.contains('='));
    if by_role {
        for text in given {
            let (role, column) = text
                .split_once('=')
                .with_context(|| format!("--columns: found `{text}`, expected ROLE=COLUMN"))?;
            anyhow::ensure!(
                columns.insert(role.to_owned(), column.to_owned()).is_none(),
                "--columns: {role} is given twice"
            );
        }
    } else if !given.is_empty() {
        anyhow::ensure!(
            given.len() == 4,
            "--columns: wrong number of columns (found {}, expected 4: x, y, e1 and e2)",
            given.len()
        );
        let roles = ["x", "y", "e1", "e2"].map(str::to_owned);
        columns.extend(roles.into_iter().zip(given.into_iter().map(str::to_owned)));
    }
    let mut presets = Vec::new();
    for path in &arguments.preset {
        presets.extend(read_presets(path)?);
    }
    let mut stated = Foreign::default();
    stated.ellipticity = arguments.ellipticity;
    stated.columns = columns;
    stated.missing = arguments.missing;
    stated.drop_missing = arguments.drop_missing;
    stated.max_modulus = arguments.max_modulus;
    stated.step = arguments.step;
    stated.presets = presets;
    Ok((stated != Foreign::default()).then_some(stated))
}

// Plain files of one set, and how they are read.
fn scored_files(
    arguments: &Arguments,
    truth: &Path,
    options: Options,
) -> anyhow::Result<(Catalogues, Reading, [ScoredSet; 1])> {
    // A file that is given twice would count as two images without noise between them.
    let mut seen = BTreeSet::new();
    for path in &arguments.catalogues {
        // Two names may lead to one file.
        let same = path.canonicalize().unwrap_or_else(|_| path.clone());
        anyhow::ensure!(
            seen.insert(same),
            "{}: this catalogue is given twice; expected one per image",
            path.display()
        );
    }
    let catalogues = Catalogues::plain(&arguments.catalogues, described(arguments)?)?;
    let reading = Reading {
        // The field and the stamps of GREAT10.
        field: Degrees(arguments.field.unwrap_or(10.0)),
        stamp: Pixels(arguments.stamp.unwrap_or(48.0)),
        sign: arguments.truth_sign,
    };
    let options = options_for(arguments, &catalogues, options);
    let threads = arguments.threads.number();
    let scored = [score_files(truth, &catalogues, &reading, options, threads)?];
    Ok((catalogues, reading, scored))
}

fn files(arguments: &Arguments, truth: &Path, options: Options) -> anyhow::Result<()> {
    let threads = arguments.threads.number();
    let (catalogues, reading, scored) = scored_files(arguments, truth, options)?;
    if arguments.aperture_mass {
        let masses = aperture::masses(
            &catalogues,
            &scored,
            |_| read_truth(truth, &reading),
            threads,
        )?;
        let title = format!("Aperture masses against {}", truth.display());
        return arguments.printing.print(&aperture::table(title, &masses));
    }
    let title = format!("Scores against {}", truth.display());
    let mut table = per_set(&scored, &title, options.definition);
    let columns = account(&catalogues)?;
    table.notes.extend(columns.iter().cloned());
    table.notes.extend(verdict_line("The catalogues", &scored));
    // The JSON of plain files has the keys of the public scoring cases of GREAT10, so that both can be compared.
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
            columns,
            definition: options.definition,
        };
        print_json(one_set_json(&scored[0], &input))?;
    } else {
        arguments.printing.print(&table)?;
    }
    let mut made_by = vec![("Truth".to_owned(), truth.display().to_string())];
    for (path, number) in arguments.catalogues.iter().zip(1..) {
        made_by.push((format!("Catalogue {number}"), path.display().to_string()));
    }
    let sections = || Ok(vec![pages::scores("catalogues", &scored, table)?]);
    arguments.report.save(&title, sections, || Ok(made_by))
}
