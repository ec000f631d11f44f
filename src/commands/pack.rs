use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shearq_files::open::{SETTINGS, is_there, read_to_string};
use shearq_submissions::check_name;

use crate::arguments::{SummaryArguments, named};
use crate::commands::score::account;
use crate::progress::Bar;
use crate::{count, tell, tell_notes, tell_unread};
use shearq_challenges::{BranchCatalogues, Presubmitting, PublicBranch, PublicChallenge};
use shearq_dataset::fingerprint;
use shearq_dataset::run::{Run, open_data};
use shearq_dataset::threads::{ALL_CORES, Pool};
use shearq_results::catalogues::Catalogues;
use shearq_results::submit::archive::is_tar_gz;
use shearq_results::submit::pack::Packing;
use shearq_results::submit::{Contents, Entry};

// Longest name of a method in bytes: a tar header has 100 for a file name.
const MAX_METHOD_BYTES: usize = 64;

// A folder or a text with such a name would be mistaken for an archive.
const ARCHIVES: [&str; 8] = ["zip", "tar", "gz", "tgz", "bz2", "xz", "zst", "7z"];

/// Write catalogues as a submission: the files that the challenge accepts, with a manifest.
///
/// A submission contains one ASCII catalogue per image (`g10_v1_objs_{set}_{image}.{method}.dat`), or one power
/// spectrum per set (`{method}_set{set}.dat`). A spectrum comes from the ellipticities averaged over the images, or
/// from cross-spectra between groups of images.
///
/// manifest.json lists the files with their SHA-256 checksums, the settings, and the covariances of cross-spectra of
/// eight or more images. The same catalogues give the same bytes. `shearq check` checks a submission, `shearq unpack`
/// unpacks an archive.
///
/// With `--challenge great3 --branch BRANCH`, the command makes the submission file of GREAT3 from a folder that `measure`
/// wrote, or from catalogues of all galaxies of a branch, after the checks of the challenge's own program (docs/great3.md).
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR", required_unless_present_any = ["foreign", "catalogues"])]
    measured: Option<PathBuf>,
    /// Catalogues of another program, described by a TOML file (docs/files.md). They are packed with the signs and
    /// the type of ellipticity that are scored.
    #[arg(long, value_name = "FILE", conflicts_with = "measured")]
    foreign: Option<PathBuf>,
    /// Data folder that the catalogues of --foreign were measured from, for the grid of spectra.
    #[arg(
        long,
        value_name = "DIR",
        requires = "foreign",
        conflicts_with = "measured"
    )]
    data: Option<PathBuf>,
    /// New folder to write to, or an archive ending in .tar.gz or .tgz.
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Name of the method in file names [default: name of the configuration or program, with `-` for `/`].
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    #[command(flatten)]
    entry: EntryArguments,
    /// Content of the submission.
    #[arg(long, value_parser = named::<Contents>(), default_value = "catalogues")]
    kind: Contents,
    /// Catalogues of GREAT3: `ID g1 g2` and perhaps `weight`, as text, FITS or Parquet; 10 for a galaxy that was not measured.
    #[arg(value_name = "CATALOGUE", requires = "branch", conflicts_with = "measured", conflicts_with_all = GREAT10_ONLY)]
    catalogues: Vec<PathBuf>,
    /// Branch of the challenge, such as control-ground-constant.
    #[arg(long, value_name = "NAME", requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    branch: Option<String>,
    /// Subfields of a branch of GREAT3 that was simulated [default: 200].
    #[arg(long, value_name = "N", requires = "branch", conflicts_with_all = GREAT10_ONLY, value_parser = clap::value_parser!(u16).range(1..=1000))]
    subfields: Option<u16>,
    /// Galaxies per side of a subfield of GREAT3 [default: 100].
    #[arg(long, value_name = "N", requires = "branch", conflicts_with_all = GREAT10_ONLY, value_parser = clap::value_parser!(u16).range(1..=100))]
    grid: Option<u16>,
    /// Leave out a galaxy of which one component is 9.9 or more. The program of GREAT3 leaves out the component alone, so that g1
    /// and g2 are means over different galaxies.
    #[arg(long, requires = "branch", conflicts_with_all = GREAT10_ONLY)]
    whole_galaxies: bool,
    #[command(flatten)]
    summary: SummaryArguments,
}

// Options without a meaning for submissions to other challenges; `file` is --entry.
const GREAT10_ONLY: [&str; 8] = [
    "foreign", "data", "method", "kind", "team", "title", "contact", "file",
];

/// Team and challenge of an entry.
#[derive(Debug, Args)]
struct EntryArguments {
    /// TOML file with the keys challenge, team, title and contact. Options replace its values.
    #[arg(long = "entry", value_name = "FILE")]
    file: Option<PathBuf>,
    /// Name of the challenge.
    #[arg(long, value_name = "NAME")]
    challenge: Option<String>,
    /// Name of the team.
    #[arg(long, value_name = "NAME")]
    team: Option<String>,
    /// One line about the entry.
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// Address for questions of the organiser. It is not published.
    #[arg(long, value_name = "TEXT")]
    contact: Option<String>,
}

impl EntryArguments {
    fn entry(&self) -> anyhow::Result<Option<Entry>> {
        let place = || match &self.file {
            Some(path) => path.display().to_string(),
            None => "the entry".into(),
        };
        let mut values = match &self.file {
            None => toml::Table::new(),
            Some(path) => {
                let text = read_to_string(path, SETTINGS).with_context(place)?;
                text.parse().with_context(place)?
            }
        };
        for (key, value) in [
            ("challenge", &self.challenge),
            ("team", &self.team),
            ("title", &self.title),
            ("contact", &self.contact),
        ] {
            // Options win over the file, so that one file serves several entries.
            if let Some(value) = value {
                values.insert(key.into(), value.clone().into());
            }
        }
        if values.is_empty() {
            return Ok(None);
        }
        for (key, option) in [("challenge", "--challenge NAME"), ("team", "--team NAME")] {
            anyhow::ensure!(
                values.contains_key(key),
                "the entry has no {key}. Try: {option}"
            );
        }
        Ok(Some(values.try_into().with_context(place)?))
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let out = &arguments.out;
    if let (Some(branch), Some(challenge)) = (&arguments.branch, &arguments.entry.challenge) {
        let packing = Presubmitting {
            catalogues: match &arguments.measured {
                Some(folder) => BranchCatalogues::Measured(folder),
                None => BranchCatalogues::Files(&arguments.catalogues),
            },
            subfields: arguments.subfields.map(usize::from),
            grid: arguments.grid.map(usize::from),
            whole_galaxies: arguments.whole_galaxies,
        };
        let branch = PublicChallenge::named(challenge)?.branch(Some(branch))?;
        return presubmit(&*branch, &packing, out, &arguments.summary);
    }
    let entry = arguments.entry.entry()?;
    let ending = out.extension().unwrap_or_default().to_string_lossy();
    anyhow::ensure!(
        is_tar_gz(out) || !ARCHIVES.contains(&ending.as_ref()),
        "--out {}: unsupported archive (found .{ending}, expected a folder, .tar.gz or .tgz)",
        out.display()
    );
    let catalogues = match (&arguments.measured, &arguments.foreign) {
        (Some(folder), _) => {
            let run = Run::require(folder)?;
            fingerprint::verify_source(folder, &run, &[], ALL_CORES)?;
            Catalogues::measured(&run, folder, &[])?
        }
        (None, Some(path)) => Catalogues::foreign(path, &[])?,
        _ => anyhow::bail!("cannot find catalogues to pack. Try: --measured DIR or --foreign FILE"),
    };
    let data = arguments.data.as_deref().map(open_data).transpose()?;
    // `/` in names of configurations would make folders in the archive.
    let own_name = || catalogues.name.replace('/', "-");
    let method = arguments.method.clone().unwrap_or_else(own_name);
    anyhow::ensure!(
        (1..=MAX_METHOD_BYTES).contains(&method.len())
            && !method.starts_with('.')
            && check_name(&method).is_ok()
            && !method.contains(|c: char| "/\\:".contains(c) || c.is_whitespace()),
        "--method: unusable name (found `{method}`, expected 1 to {MAX_METHOD_BYTES} bytes without `/`, `\\`, `:`, blanks and a leading `.`)"
    );
    let packing = Packing {
        catalogues: &catalogues,
        data: data.as_ref(),
        method,
        contents: arguments.kind,
        entry,
    };
    // Before the archive is opened: catalogues that cannot be packed leave no file.
    let galaxies = packing.galaxies()?;
    // A catalogue with a misspelt name would otherwise be missing from the submission without notice.
    tell_unread(catalogues.files.unread());
    tell_notes(account(&catalogues)?);
    let mut bar = Bar::new("packing", galaxies);
    let files = packing.write(out, &mut bar)?;
    drop(bar);
    tell(format_args!(
        "wrote {} and a manifest to {}",
        count(files, "file"),
        out.display()
    ));
    arguments
        .summary
        .print(|| serde_json::json!({ "out": out, "files": files, "galaxies": galaxies }))
}

fn presubmit(
    branch: &dyn PublicBranch,
    packing: &Presubmitting<'_>,
    out: &Path,
    summary: &SummaryArguments,
) -> anyhow::Result<()> {
    // As of other submissions: an earlier one may have been sent.
    anyhow::ensure!(
        !is_there(out),
        "--out {}: the file exists already; expected a new file",
        out.display()
    );
    let ending = out.extension().unwrap_or_default().to_string_lossy();
    anyhow::ensure!(
        !ARCHIVES.contains(&ending.as_ref()),
        "--out {}: a submission to {} is one text file (found .{ending}, expected a name such as entry.txt)",
        out.display(),
        branch.title()
    );
    let packed = branch.pack(packing, &Pool::new(ALL_CORES)?);
    let Some(packed) = packed else {
        anyhow::bail!("{} has no pre-submission of catalogues", branch.title());
    };
    // Written only after all checks, so that a faulty catalogue leaves no file.
    let packed = packed?;
    packed.write(out)?;
    tell(format_args!("{}: {}", out.display(), packed.note));
    summary.print(|| serde_json::json!({ "out": out, "files": 1, "note": packed.note }))
}
