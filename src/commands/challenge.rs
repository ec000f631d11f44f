use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args, Subcommand};
use shearq_challenge::create::{
    Folders, Plan, Scenes, Simulation, of_images, of_scenes, simulated,
};
use shearq_challenge::entry::{Entry, check_team};
use shearq_challenge::inbox;
use shearq_challenge::judge::{Arrivals, Judge};
use shearq_challenge::kind::{ENTRIES_PER_TEAM, Kind, MAX_M, RankBy};
use shearq_challenge::page::View;
use shearq_challenge::ranking::{Board, Decisions, rank as ranked};
use shearq_challenge::scenes::{self, expected_m_error};
use shearq_challenge::seal::{BOARD_FILE, is_open_to_others, verify_public};
use shearq_challenge::shapes::References;
use shearq_challenge::terms::{Challenge, Deadline, TUNING_ENTRIES, now};
use shearq_dataset::layout::{DataFolder, MAX_IMAGE};
use shearq_files::FileError;
use shearq_files::open::is_there;
use shearq_render::escape::line;
use shearq_render::table::TableFormat;
use shearq_results::submit::check::{Finding, Severity, check_sent};
use shearq_results::submit::{Sent, Submission};

use super::check::report;
use super::simulate::{OTHER_DATA, SceneArguments, fits_of};
use crate::arguments::{Form, SetList, SummaryArguments, Threads, named, page, positive};
use crate::progress::{Bar, mark_resumable};
use crate::{count, tell};

/// Run a challenge: write blind data, check entries, and rank them.
///
/// `new` writes a public folder for participants and a private folder with the true shear. `check` checks an entry
/// without the true shear. `rank` scores entries and writes a leaderboard (docs/run-a-challenge.md).
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(
        after_help = "Examples:\n  shearq challenge new --name pilot --sets 2,8 --images 20 --public pilot --private truth\n  shearq challenge new --name theirs --data rendered --public theirs --private theirs-truth\n  shearq challenge new --name pipelines --kind scenes --scenes 400 --public scenes --private scenes-truth"
    )]
    New(Box<NewArguments>),
    #[command(after_help = "Example:\n  shearq challenge check entry.tar.gz --challenge pilot")]
    Check(CheckArguments),
    #[command(
        after_help = "Example:\n  shearq challenge rank inbox --challenge pilot --truth truth --store results --report leaderboard.html"
    )]
    Rank(RankArguments),
}

/// Write the data of a new challenge: a public and a private folder.
///
/// The public folder has images, PSFs, challenge.toml, checksums, and a README for participants. The private folder has
/// the true shear, the intrinsic shapes, the seed and the settings. The public folder does not determine the private
/// folder.
///
/// The images are simulated (--sets, --scenes), with a seed of 128 bits that is drawn and kept in the private folder, or copied from
/// another simulator (--data). The same command resumes a stopped simulation.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("source").required(true).args(["sets", "data", "scenes"]))]
#[command(group = ArgGroup::new(OTHER_DATA).args(SETS_ONLY).multiple(true))]
struct NewArguments {
    /// Name of the challenge. Entries state it.
    #[arg(long, value_name = "NAME", value_parser = name)]
    name: String,
    /// Kind of the challenge: metric, layout and rules.
    #[arg(long, value_name = "KIND", default_value = "great10", value_parser = named::<Kind>())]
    kind: Kind,
    /// New folder for participants.
    #[arg(long, value_name = "DIR")]
    public: PathBuf,
    /// New folder that must stay secret.
    #[arg(long, value_name = "DIR")]
    private: PathBuf,
    /// Sets to simulate, such as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST", requires = "images")]
    sets: Option<SetList>,
    /// Simulated images per set.
    #[arg(long, value_name = "N", requires = "sets", conflicts_with = "data", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    /// Galaxies per side of a simulated image [default: 100].
    #[arg(long, value_name = "N", conflicts_with = "data", value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: Option<u16>,
    /// Factor on the simulated shear power spectrum [default: drawn from 0.5 to 2, and secret].
    #[arg(long, value_name = "A", conflicts_with = "data")]
    amplitude: Option<f64>,
    /// Extra slope of the simulated shear power spectrum [default: drawn from -0.2 to 0.2, and secret].
    #[arg(long, value_name = "T", conflicts_with = "data")]
    tilt: Option<f64>,
    /// Data folder with images and PSFs of another simulator. Pixels are copied under new headers.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Tables of the true shear of --data: x, y, g1, g2, with `{set}` for the set number [default: as in the data folder].
    #[arg(long, value_name = "PATTERN", requires = "data", conflicts_with_all = ["sets", "images", "grid", "amplitude", "tilt"])]
    truth_table: Option<String>,
    #[command(flatten)]
    scene: SceneArguments,
    /// Fits to galaxies from which those of scenes are drawn, as in `simulate --galaxies`.
    #[arg(long, value_name = "FILE", requires = "scenes", conflicts_with = OTHER_DATA)]
    galaxies: Option<PathBuf>,
    /// Largest |m| of ranked entries of scenes, to which twice its error is added [default: 0.02].
    #[arg(long, value_name = "M", requires = "scenes", conflicts_with = OTHER_DATA, value_parser = max_m)]
    max_m: Option<f64>,
    /// Metric that ranks entries [default: q-calibrated, or qc if each set has one shear].
    ///
    /// Neither default rewards shrunk ellipticities or entries without images. `q` does while noise dominates it, `m`
    /// can be tuned with two entries, and `c` measures one property only.
    #[arg(long, value_parser = named::<RankBy>())]
    metric: Option<RankBy>,
    /// Accept power spectra, too, with `--metric q` or `q-corrected`.
    ///
    /// Entry by entry, a team can tune a spectrum to the truth without images.
    #[arg(long)]
    spectra: bool,
    /// Largest number of entries of a team, because published values reveal the truth entry by entry [default: 10].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    entries_per_team: Option<u32>,
    /// First day of entries in UTC, or a moment with its zone, such as 2026-12-01T18:00[Europe/Berlin].
    #[arg(long, value_name = "TIME")]
    opens: Option<Deadline>,
    /// Last day of entries in UTC, or a moment with its zone. Later entries have their own board.
    #[arg(long, value_name = "TIME")]
    closes: Option<Deadline>,
    /// Accept entries of some sets. They are listed without a rank.
    #[arg(long)]
    partial: bool,
    /// Where the data and the rules are published, for the leaderboard.
    #[arg(long, value_name = "URL", default_value = "")]
    address: String,
    /// Address for participants.
    #[arg(long, value_name = "TEXT", default_value = "")]
    contact: String,
    /// Version of the data, for a second release under the same name.
    #[arg(long, value_name = "N", default_value_t = 1)]
    data_version: u32,
    #[command(flatten)]
    threads: Threads,
}

// Above it, the limit is one for nothing.
const LARGEST_MAX_M: f64 = 0.5;

fn max_m(text: &str) -> Result<f64, String> {
    let found = positive(text).ok().filter(|own| *own <= LARGEST_MAX_M);
    found.ok_or_else(|| format!("expected a positive number up to {LARGEST_MAX_M}"))
}

// Options without a meaning for scenes, whose entries have one metric.
const SETS_ONLY: [&str; 10] = [
    "sets",
    "images",
    "grid",
    "amplitude",
    "tilt",
    "data",
    "truth_table",
    "metric",
    "spectra",
    "partial",
];

/// Check an entry, without the true shear.
///
/// ENTRY is an archive (.tar.gz, .zip) or a folder of catalogues or power spectra. Grid, sets and conventions come from
/// challenge.toml. If the images are there, they are measured for comparison, which takes as long as `48/linear/star`. This finds
/// swapped or flipped components, exchanged rows, images without measured shapes, and distortions that are given as
/// shear. Images that differ from SHA256SUMS and symbolic links are refused.
///
/// Of scenes, an entry has a catalogue of each exposure in the format of any program. Missing scenes and numbers that are not
/// finite are found, and the command prints which column is used as what.
///
/// Exit code 0: no errors, perhaps warnings; 1: errors.
#[derive(Debug, Args)]
struct CheckArguments {
    /// Archive or folder to check.
    entry: PathBuf,
    /// Public folder of the challenge, or its challenge.toml.
    #[arg(long, value_name = "DIR")]
    challenge: PathBuf,
    #[command(flatten)]
    summary: SummaryArguments,
    /// Private folder, for organisers: if there are no errors, sign the time of arrival in ENTRY.receipt.toml. An earlier
    /// receipt of the same content is kept.
    #[arg(long, value_name = "DIR")]
    truth: Option<PathBuf>,
    /// Team of the receipt [default: as in the manifest, or the name of the file].
    #[arg(long, value_name = "NAME", requires = "truth", value_parser = name)]
    team: Option<String>,
    #[command(flatten)]
    threads: Threads,
}

/// Check, score and rank entries.
///
/// INBOX is an archive (.tar.gz, .zip), a folder of catalogues or power spectra, or a folder of such. A folder in an inbox
/// is the name of the team of all entries in it. Files that are no entries are listed.
///
/// Every entry that is compared with the true shear counts towards the limit of its team and is kept in the results
/// store. Later runs score only new entries, so a stopped run continues, and several processes may share a store.
/// Without INBOX, the store alone is ranked. Until the challenge closes, the table has the rank metric alone, rounded to
/// its error; --detail shows you more.
///
/// The time of an entry is that of its receipt, which `check --truth` signs, that of --received, or the time at which
/// `rank` first scored it. board.toml in the private folder withdraws entries and names teams
/// (docs/run-a-challenge.md).
#[derive(Debug, Args)]
struct RankArguments {
    /// Entries: archives, or folders of entries.
    #[arg(value_name = "INBOX")]
    inbox: Vec<PathBuf>,
    /// Public folder of the challenge.
    #[arg(long, value_name = "DIR")]
    challenge: PathBuf,
    /// Private folder of the challenge.
    #[arg(long, value_name = "DIR")]
    truth: PathBuf,
    /// Results store of the entries.
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
    /// Entry of the organiser, which is shown without a rank. May be given several times.
    #[arg(long, value_name = "PATH")]
    reference: Vec<PathBuf>,
    /// Write the leaderboard to this HTML file, and as CSV and JSON with the same name.
    #[arg(long, value_name = "FILE", value_parser = page)]
    report: Option<PathBuf>,
    /// Write a table, a page and messages for you alone, with all metrics, those of single sets, and what the comparison with
    /// the true shear showed. Only you can read the files.
    #[arg(long)]
    detail: bool,
    /// When entries without a receipt arrived: a day in UTC, a moment with its zone, or `files` for the time of each file
    /// [default: when `rank` first scores them].
    #[arg(long, value_name = "TIME", value_parser = arrivals)]
    received: Option<Arrivals>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

fn arrivals(text: &str) -> Result<Arrivals, String> {
    match text {
        "files" => Ok(Arrivals::OfFiles),
        time => time.parse::<Deadline>().map(|time| Arrivals::At(time.last)),
    }
}

fn name(text: &str) -> Result<String, String> {
    shearq_submissions::check_name(text)
        .map(|()| text.to_owned())
        .map_err(|error| error.to_string())
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::New(arguments) => new(arguments),
        Command::Check(arguments) => check_entry(arguments),
        Command::Rank(arguments) => rank(arguments),
    }
}

fn new(arguments: &NewArguments) -> anyhow::Result<()> {
    mark_resumable();
    let plan = Plan {
        name: arguments.name.clone(),
        version: arguments.data_version,
        kind: arguments.kind,
        metric: arguments.metric,
        spectra: arguments.spectra,
        contact: arguments.contact.clone(),
        address: arguments.address.clone(),
        entries_per_team: Some(arguments.entries_per_team.unwrap_or(ENTRIES_PER_TEAM)),
        opens: arguments.opens.clone(),
        closes: arguments.closes.clone(),
        partial: arguments.partial,
        max_m: (arguments.kind == Kind::Scenes).then(|| arguments.max_m.unwrap_or(MAX_M)),
    };
    let folders = Folders {
        public: &arguments.public,
        private: &arguments.private,
    };
    // Before hours of simulation.
    if let Some(closes) = &arguments.closes
        && closes.last < now()
    {
        tell(format_args!(
            "warning: --closes {closes} is in the past, so that all entries without an earlier receipt are late"
        ));
    }
    if let Some(count) = arguments.scene.scenes {
        return new_scenes(arguments, &plan, folders, count);
    }
    let threads = arguments.threads.number();
    let challenge = match (&arguments.data, &arguments.sets, arguments.images) {
        (None, Some(sets), Some(images)) => {
            let simulation = Simulation {
                sets: sets.simulated()?,
                images,
                grid: arguments.grid.map_or(100, usize::from),
                amplitude: arguments.amplitude,
                tilt: arguments.tilt,
            };
            let galaxies =
                u64::from(images) * (simulation.sets.len() * simulation.grid.pow(2)) as u64;
            let mut bar = Bar::new("simulating", galaxies);
            simulated(&plan, &simulation, folders, threads, &mut bar)?
        }
        (Some(data), ..) => {
            let data = DataFolder::open(data)?;
            // Images of other simulators state their number of galaxies only when they are opened.
            let mut bar = Bar::new("copying", 0);
            let truth = arguments.truth_table.as_deref();
            of_images(&plan, &data, truth, folders, threads, &mut bar)?
        }
        _ => anyhow::bail!("cannot determine the data. Try: --sets LIST --images N, or --data DIR"),
    };
    let (data, rules) = (&challenge.data, &challenge.rules);
    if let Some(found) = rules.tunable_entries() {
        tell(format_args!(
            "warning: a team can tune {} to the truth with {TUNING_ENTRIES} entries (found {found} per team). Try: --entries-per-team {}",
            rules.metric.label(),
            TUNING_ENTRIES - 1
        ));
    }
    tell(format_args!(
        "wrote {} of {} each to {}; keep {} secret",
        count(data.sets.len(), "set"),
        count(data.images as usize, "image"),
        arguments.public.display(),
        arguments.private.display()
    ));
    Ok(())
}

fn new_scenes(
    arguments: &NewArguments,
    plan: &Plan,
    folders: Folders<'_>,
    count: u32,
) -> anyhow::Result<()> {
    let (fits, galaxies) = fits_of(arguments.galaxies.as_deref())?;
    // The seed is drawn later.
    let settings = arguments.scene.settings(0);
    let area = settings.area_arcmin2();
    let error = expected_m_error(f64::from(count) * area);
    let scenes = Scenes {
        count,
        settings,
        fits,
        galaxies,
    };
    let threads = arguments.threads.number();
    of_scenes(plan, &scenes, folders, threads, |objects| {
        Box::new(Bar::new("simulating", objects))
    })?;
    tell(format_args!(
        "wrote {} of {area:.2} arcmin², which determine m to about {error:.3}, to {}; keep {} secret",
        crate::count(count as usize, "scene"),
        arguments.public.display(),
        arguments.private.display()
    ));
    Ok(())
}

// The form of an entry of scenes.
fn check_scenes(sent: &Sent, entry: &Path, sets: &[u32]) -> Vec<Finding> {
    let finding = |severity, message| Finding {
        path: entry.to_owned(),
        severity,
        check: "catalogues",
        message,
    };
    match scenes::check(sent, sets) {
        Ok((columns, undivided)) => {
            columns.iter().for_each(|line| tell(format_args!("{line}")));
            let warning = undivided.map(|text| finding(Severity::Warning, text));
            warning.into_iter().collect()
        }
        Err(error) => {
            let message = scenes::shortened(&error.to_string(), sent);
            vec![finding(Severity::Error, message)]
        }
    }
}

// Signs the arrival of an entry without errors.
fn sign(judge: Option<&Judge>, entry: &Path, team: Option<&str>) -> anyhow::Result<()> {
    if let Some(judge) = judge {
        let receipt = judge.sign(entry, team)?;
        tell(format_args!("receipt: {}", receipt.display()));
    }
    Ok(())
}

fn check_entry(arguments: &CheckArguments) -> anyhow::Result<()> {
    let CheckArguments {
        entry,
        challenge: place,
        summary,
        truth,
        team,
        threads,
    } = arguments;
    let threads = threads.number();
    let judge = truth
        .as_ref()
        .map(|truth| Judge::open(place, truth, threads))
        .transpose()?;
    let challenge = Challenge::read(place)?;
    // A link could name any file of the organiser's system. An absent entry is reported below.
    if is_there(entry) {
        inbox::refuse_links(entry, &challenge.data)?;
    }
    let sent = match challenge.open(entry) {
        Ok(sent) => sent,
        Err(error) => return report(&[Finding::unreadable(error)], entry, summary.is_json()),
    };
    if challenge.data.scene.is_some() {
        let findings = check_scenes(&sent, entry, &challenge.data.sets);
        report(&findings, entry, summary.is_json())?;
        return sign(judge.as_ref(), entry, team.as_deref());
    }
    let expected = challenge.expected()?;
    let mut findings = check_sent(&sent, &expected, &mut |_| {});
    // Unreadable entries are among the findings already.
    if let Ok(submission) = Submission::read(&sent) {
        let stated = submission.manifest.as_ref();
        let stated = stated.and_then(|manifest| manifest.entry.as_ref());
        let accepted = challenge.rules.accept(&submission).map(|_| ());
        let named = stated.map_or(Ok(()), |entry| check_team(&entry.team));
        for (check, result) in [("contents", accepted), ("team", named)] {
            findings.extend(result.err().map(|message| Finding {
                path: entry.clone(),
                severity: Severity::Error,
                check,
                message,
            }));
        }
    }
    // With challenge.toml alone, participants can check the form of an entry without downloading the images.
    let references = match place.is_dir() {
        true => {
            verify_public(place, threads)?;
            let (data, sets) = (DataFolder::open(place)?, &challenge.data.sets);
            let ids = References::ids(&data, sets)?;
            let galaxies = (ids.len() * expected.grid.cells()) as u64;
            let mut bar = Bar::new("measuring", galaxies);
            Some(References::measure(
                &data,
                &ids,
                expected.grid,
                threads,
                &mut bar,
            )?)
        }
        false => None,
    };
    match references.filter(|references| !references.is_empty()) {
        Some(references) => findings.extend(references.findings(&sent)?),
        None => tell(format_args!(
            "note: the shapes were not compared with the images, because {} contains no images",
            place.display()
        )),
    }
    // Before the receipt, because it fails if there are errors: an entry that cannot be scored must not hold a place in time.
    report(&findings, entry, summary.is_json())?;
    sign(judge.as_ref(), entry, team.as_deref())
}

fn rank(arguments: &RankArguments) -> anyhow::Result<()> {
    mark_resumable();
    let threads = arguments.threads.number();
    let judge = Judge::open(&arguments.challenge, &arguments.truth, threads)?;
    // Before scoring, which takes minutes: a mistake in board.toml is an error at once.
    let decisions = Decisions::read(&arguments.truth)?;
    if is_open_to_others(&arguments.truth) {
        tell(format_args!(
            "warning: {}: other users may read the truth. Try: chmod -R go= {0}",
            arguments.truth.display()
        ));
    }
    let (mut sendings, mut remarks) = (Vec::new(), Vec::new());
    for (paths, reference) in [(&arguments.inbox, false), (&arguments.reference, true)] {
        let found = inbox::find(paths, judge.challenge.data.scene.is_some())?;
        sendings.extend(found.sendings.into_iter().map(|own| (own, reference)));
        remarks.extend(found.remarks);
    }
    let galaxies = judge.challenge.data.galaxies() * sendings.len() as u64;
    let mut bar = Bar::new("scoring", galaxies);
    let arrivals = arguments.received.unwrap_or(Arrivals::Now);
    let round = judge.round(&sendings, arrivals, &arguments.store, threads, &mut bar)?;
    remarks.extend(round.remarks);
    drop(bar);
    let mut entries = match arguments.store.is_dir() {
        true => judge.entries(&arguments.store)?,
        false => Vec::new(),
    };
    let rules = &judge.challenge.rules;
    let path = arguments.truth.join(BOARD_FILE);
    decisions
        .apply(&mut entries, &judge.key)
        .map_err(|message| FileError::new(path, message))?;
    let noise = judge.key.noise.unwrap_or_default();
    let board = ranked(&entries, &judge.challenge, judge.constant.as_ref(), &noise);
    let view = View {
        challenge: &judge.challenge,
        board: &board,
        // Names of files and reasons reveal who sent an entry.
        refused: match decisions.anonymous {
            true => &[],
            false => &round.refused,
        },
        zero_shear: judge.zero_shear(),
        constant: judge.constant.as_ref(),
        noise: &noise,
        open: rules.is_open(now()),
        detail: arguments.detail,
    };
    // The table first: warnings are for the organiser, and must not delay or replace the board.
    arguments.form.print(&match arguments.form.format {
        TableFormat::Csv | TableFormat::Json => view.table(),
        _ => view.shown(),
    })?;
    for refused in &round.refused {
        tell(format_args!(
            "warning: {}: not scored: {}",
            line(&refused.path.to_string_lossy()),
            refused.reason
        ));
    }
    for (path, remark) in &remarks {
        let path = line(&path.to_string_lossy());
        tell(format_args!("warning: {path}: {remark}"));
    }
    for (info, reason) in &board.excluded {
        tell(format_args!(
            "warning: the entry of {} of {} does not count: {reason}",
            info.team, info.received
        ));
    }
    let with_findings = entries
        .iter()
        .filter(|entry| !entry.info.findings.is_empty());
    for Entry { info, .. } in with_findings.filter(|_| arguments.detail) {
        let findings = info.findings.join("; ");
        tell(format_args!("{} of {}: {findings}", info.file, info.team));
    }
    let late = board.of(Board::Late).flat_map(|standing| &standing.entries);
    let unsigned = late.filter(|entry| !entry.info().receipt).count();
    if unsigned > 0 {
        tell(format_args!(
            "warning: {} late, because without a receipt entries arrive when `rank` first scores them. Try: --received files, or --received TIME",
            match unsigned {
                1 => "1 entry is".to_owned(),
                _ => format!("{unsigned} entries are"),
            }
        ));
    }
    tell(format_args!(
        "entries: {} scored, {} scored earlier, {} not scored",
        round.scored,
        round.known,
        round.refused.len() + round.unscored
    ));
    if let Some(path) = &arguments.report {
        view.save(path)?;
    }
    Ok(())
}
