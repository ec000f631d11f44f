//! `score`, `pack`, `check` and `compare` for public challenges other than GREAT10.

use std::path::{Path, PathBuf};

use shearq_dataset::threads::Pool;
use shearq_render::table::Table;
use shearq_results::published::{Branch, Challenge, Packing, Score, Truth, ranking};
use shearq_results::submit::check::Finding;

use crate::tell;

pub(super) fn branch_of(challenge: &str, branch: Option<&str>) -> anyhow::Result<Box<dyn Branch>> {
    Ok(Challenge::named(challenge)?.branch(branch)?)
}

pub(super) fn score(
    branch: &dyn Branch,
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
    Ok(branch.score(truth, submission, &Pool::new(threads)?)?)
}

pub(super) fn leaderboard(
    branch: &dyn Branch,
    truth: Option<Truth<'_>>,
    submissions: &[PathBuf],
    threads: usize,
) -> anyhow::Result<Table> {
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
        own.push((name, branch.score(truth, submission, &pool)?));
    }
    Ok(ranking(branch, &own))
}

pub(super) fn pack(branch: &dyn Branch, packing: &Packing<'_>, out: &Path) -> anyhow::Result<()> {
    let packed = branch.pack(packing, &Pool::new(0)?);
    let Some(packed) = packed else {
        anyhow::bail!("{} has no pre-submission of catalogues", branch.title());
    };
    // Written only after all checks, so that a faulty catalogue leaves no file.
    let packed = packed?;
    packed.write(out)?;
    tell(format_args!("{}: {}", out.display(), packed.note));
    Ok(())
}

pub(super) fn check(branch: &dyn Branch, submission: &Path) -> Vec<Finding> {
    let fault = branch.check(submission).err();
    fault.into_iter().map(Finding::unreadable).collect()
}
