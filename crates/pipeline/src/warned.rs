//! Warnings of many images: one line for each kind.

use std::collections::BTreeMap;

use shearq_measure::Warning;

use super::PipelineError;
use super::engine::Progress;
use shearq_dataset::images::ImageId;

/// Kinds of warnings that were shown, and the number of further images of each.
#[derive(Debug, Default)]
pub(crate) struct Warned {
    kinds: BTreeMap<&'static str, usize>,
}

impl Warned {
    /// Shows the first warning of each kind, and counts images with others.
    ///
    /// # Errors
    /// If no catalogue should be made of the image.
    pub(crate) fn add<'w>(
        &mut self,
        id: ImageId,
        warnings: impl IntoIterator<Item = &'w Warning>,
        progress: &mut dyn Progress,
    ) -> Result<(), PipelineError> {
        for warning in warnings {
            if warning.is_fatal() {
                let ImageId { set, image } = id;
                return Err(PipelineError::Request(format!(
                    "set {set:02} image {image:03}: {warning}"
                )));
            }
            match self.kinds.get_mut(warning.kind()) {
                Some(more) => *more += 1,
                None => {
                    self.kinds.insert(warning.kind(), 0);
                    let ImageId { set, image } = id;
                    progress.warn(&format!(
                        "warning: set {set:02} image {image:03}: {warning}"
                    ));
                }
            }
        }
        Ok(())
    }

    /// Shows how many more images have each kind of warning that was shown.
    pub(crate) fn finish(self, progress: &mut dyn Progress) {
        for (kind, more) in self.kinds.iter().filter(|(_, more)| **more > 0) {
            let images = if *more == 1 {
                "image has"
            } else {
                "images have"
            };
            progress.warn(&format!(
                "warning: {more} more {images} the warning \"{kind}\""
            ));
        }
    }
}
