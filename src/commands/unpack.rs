use std::path::PathBuf;

use clap::Args;

use crate::{count, tell};
use shearq_results::submit::MANIFEST_FILE;
use shearq_results::submit::archive::{read_archive, unpack};

/// Unpack an archive that `pack` wrote, and verify its files.
///
/// The command compares every file with the checksums of the manifest. It refuses archives that are damaged, that
/// contain changed, missing or additional files, or that contain links or several folders. After a refusal no file remains.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Archive to unpack (.tar.gz or .zip).
    archive: PathBuf,
    /// New folder to write to.
    #[arg(long, value_name = "DIR", required_unless_present = "verify")]
    out: Option<PathBuf>,
    /// Require a manifest. Without --out, only verify the archive.
    #[arg(long)]
    verify: bool,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (archive, verify) = (&arguments.archive, arguments.verify);
    let unpacked = match &arguments.out {
        Some(out) => unpack(archive, out, verify)?,
        None => {
            let read = read_archive(archive, None, None)?;
            read.verify(archive, verify)?;
            read
        }
    };
    // Archives by hand or by other programs have no manifest. They are unpacked, but the message must not claim a verification.
    let compared = match &unpacked.manifest {
        Some(_) => format!("agree with {MANIFEST_FILE}"),
        None => format!("were not verified, because there is no {MANIFEST_FILE}"),
    };
    tell(format_args!(
        "{} of {} {compared}",
        count(unpacked.files.len(), "file"),
        archive.display()
    ));
    Ok(())
}
