//! `shearq unpack`.

use std::path::PathBuf;

use clap::Args;

use crate::{count, tell};
use shearq_results::submit::archive::{read, unpack};
use shearq_results::submit::manifest::MANIFEST_FILE;

/// Unpack an archive that `pack` wrote, if it is what was packed.
///
/// Every file is compared with the manifest's checksums. An archive with changed, missing or further
/// files, damaged, or holding anything but plain files is refused, and nothing is left of it. The folder
/// appears whole or not at all.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Archive, .tar.gz.
    archive: PathBuf,
    /// New folder to write to.
    #[arg(long, value_name = "DIR", required_unless_present = "verify")]
    out: Option<PathBuf>,
    /// Insist on a manifest, without which there is nothing to compare with. Without --out the archive is
    /// only verified.
    #[arg(long)]
    verify: bool,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        archive,
        out,
        verify,
    } = arguments;
    let unpacked = match out {
        Some(out) => unpack(archive, out, *verify)?,
        None => {
            let read = read(archive, None)?;
            read.verify(archive, *verify)?;
            read
        }
    };
    let compared = match &unpacked.manifest {
        Some(_) => format!("are as {MANIFEST_FILE} says"),
        None => format!("were not verified: there is no {MANIFEST_FILE}"),
    };
    tell(format_args!(
        "{} of {} {compared}",
        count(unpacked.files.len(), "file"),
        archive.display()
    ));
    Ok(())
}
