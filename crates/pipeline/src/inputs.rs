//! Compares the files of a run with the fingerprints in its catalogues, in threads.

use std::path::Path;

use shearq_dataset::fingerprint::Inputs;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, LAYOUT_FILE, Layout};
use shearq_dataset::run::{Run, Source};
use shearq_files::FileError;

use super::PipelineError;
use super::engine;

/// Checks that the catalogues of `images` in `out` were measured from the present files.
pub(crate) fn verify_images(
    inputs: &Inputs<'_>,
    out: &Path,
    images: &[ImageId],
    threads: usize,
) -> Result<(), PipelineError> {
    engine::ordered(
        threads,
        |feeder| {
            for &id in images {
                if !feeder.push(id) {
                    break;
                }
            }
            Ok(())
        },
        || (),
        |(), id| Ok(inputs.verify_image(out, id)?),
        |()| Ok(()),
    )
}

/// Checks that every catalogue of `sets` (of all if empty) in a results folder was measured from the present files in
/// `data`.
pub fn verify(
    data: &DataFolder,
    out: &Path,
    run: &Run,
    sets: &[u32],
    threads: usize,
) -> Result<(), PipelineError> {
    if let Source::Folder { layout, .. } = &run.source {
        let of = |layout: &Layout| (layout.field_degrees, layout.truth_sign);
        let (then, now) = (of(layout), of(data.layout()));
        if then != now {
            let message = format!(
                "field in degrees and sign of the truth are {now:?}; {} was measured with {then:?}",
                out.display()
            );
            return Err(FileError::new(data.root().join(LAYOUT_FILE), message).into());
        }
    }
    let files = run.catalogues(out, sets)?;
    let of_set = |set| {
        let images = files.of_set(set).into_iter();
        images.map(move |(image, _)| ImageId { set, image })
    };
    let images: Vec<ImageId> = files.sets().into_iter().flat_map(of_set).collect();
    verify_images(&Inputs::new(run, data, &images)?, out, &images, threads)
}
