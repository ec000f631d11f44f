//! `score`, `pack`, `check` and `compare` for public challenges other than GREAT10.

use std::path::{Path, PathBuf};

use shearq_dataset::threads::{ALL_CORES, Pool};
use shearq_render::table::Table;
use shearq_results::published::{
    Presubmitting, PublicBranch, PublicChallenge, Score, Truth, ranking,
};
use shearq_results::submit::check::Finding;
use shearq_scoring::great3::SUBFIELDS;

use super::pack::ARCHIVES;
use crate::tell;
use shearq_files::open::is_there;

pub(super) fn branch_of(
    challenge: &str,
    branch: Option<&str>,
) -> anyhow::Result<Box<dyn PublicBranch>> {
    Ok(PublicChallenge::named(challenge)?.branch(branch)?)
}

pub(super) fn score(
    branch: &dyn PublicBranch,
    truth: Truth<'_>,
    submissions: &[PathBuf],
    threads: usize,
) -> anyhow::Result<Score> {
    let [submission] = submissions else {
        anyhow::bail!(
            "--challenge: found {} submissions, expected one",
            submissions.len()
        );
    };
    let score = branch.score(truth, submission, &Pool::new(threads)?)?;
    for warning in score.refusal.iter().chain(&score.warnings) {
        tell(format_args!("warning: {}: {warning}", submission.display()));
    }
    Ok(score)
}

pub(super) fn leaderboard(
    branch: &dyn PublicBranch,
    truth: Option<Truth<'_>>,
    submissions: &[PathBuf],
    threads: usize,
) -> anyhow::Result<Table> {
    anyhow::ensure!(
        !branch.leaderboard().is_empty(),
        "--leaderboard: no published entries of {} are known (expected --challenge great3)",
        branch.title()
    );
    let pool = Pool::new(threads)?;
    let mut own: Vec<(String, Score)> = Vec::new();
    for submission in submissions {
        let Some(truth) = truth else {
            anyhow::bail!(
                "{}: cannot be scored without the true shear. Try: --truth PATH",
                submission.display()
            );
        };
        let name = submission.display().to_string();
        let score = branch.score(truth, submission, &pool)?;
        // As in own challenges, a rank of an entry that measures no shear would be luck.
        if let Some(refusal) = &score.refusal {
            anyhow::bail!("{name}: not ranked: {refusal}");
        }
        for warning in &score.warnings {
            tell(format_args!("warning: {name}: {warning}"));
        }
        own.push((name, score));
    }
    let mut table = ranking(branch, &own);
    if let Some(subfields) = truth.and_then(|truth| truth.subfields) {
        table.notes.push(format!(
            "Your submissions have {subfields} subfields, the published ones {SUBFIELDS}: Q of fewer is noisier, and usually lower."
        ));
    }
    Ok(table)
}

pub(super) fn pack(
    branch: &dyn PublicBranch,
    packing: &Presubmitting<'_>,
    out: &Path,
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
    Ok(())
}

pub(super) fn check(
    branch: &dyn PublicBranch,
    submission: &Path,
    subfields: Option<usize>,
) -> Vec<Finding> {
    let fault = branch.check(submission, subfields).err();
    fault.into_iter().map(Finding::unreadable).collect()
}
