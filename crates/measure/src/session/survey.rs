//! Surveys of stamps and stars, before galaxies are measured.
//!
//! Rows are read one after another and looked at in several threads. What is found is added in the order of the stamps,
//! so that it does not depend on the threads.

use std::ops::{ControlFlow, Range};
use std::sync::Arc;

use ndarray::{ArrayView3, Axis, Slice};

use super::source::{StampRows, StampSource, Threads};
use crate::error::MeasureError;
use crate::galaxy::Measurer;
use crate::noise::{NoisePlan, NoiseSurvey, Survey};
use crate::pixel::{Pixel, Pixels};
use crate::psf::{CommonProfile, StarSurvey};
use crate::psfs::Psfs;

/// The noise, the sky and the galaxy size of an image; `None` if galaxies on all of its stamps will be flagged.
pub(super) fn noise<'a, S: StampSource<'a>>(
    plan: &NoisePlan,
    source: &mut S,
    threads: &impl Threads,
) -> Result<Option<Arc<Survey>>, S::Error> {
    let rows = source.rows();
    let chosen = plan.rows(rows.columns, rows.len());
    let mut pass = |mut all: NoiseSurvey| {
        let empty = all.clone();
        scan(
            (rows, &chosen, threads),
            |row| source.stamps(row),
            |stamps, range| {
                let mut survey = empty.clone();
                match &**stamps {
                    Pixels::Single(stamps) => add(&mut survey, stamps.view(), range)?,
                    Pixels::Double(stamps) => add(&mut survey, stamps.view(), range)?,
                }
                Ok(survey)
            },
            |found| {
                all.join(&found)?;
                Ok(ControlFlow::Continue(()))
            },
        )?;
        Ok::<_, S::Error>(all)
    };
    let mut survey = pass(plan.survey())?;
    if let Some(again) = survey.without_sky() {
        survey = pass(again)?;
    }
    Ok(survey.shared()?)
}

fn add<T: Pixel>(
    survey: &mut NoiseSurvey,
    mut stamps: ArrayView3<'_, T>,
    range: Range<usize>,
) -> Result<(), MeasureError> {
    stamps.slice_axis_inplace(Axis(0), Slice::from(range));
    stamps.outer_iter().try_for_each(|stamp| survey.add(stamp))
}

/// What noisy stars, one per galaxy, have in common. `None` if there is one PSF for all galaxies, a formula, no noise, or
/// the configuration uses stars as they are.
pub(super) fn stars<'a, S: StampSource<'a>>(
    measurer: &Measurer,
    source: &mut S,
    chosen: &[usize],
    threads: &impl Threads,
) -> Result<Option<Arc<CommonProfile>>, S::Error> {
    if measurer.star_looker().is_none() {
        return Ok(None);
    }
    let mut survey = StarSurvey::default();
    let rows = source.rows();
    scan(
        (rows, chosen, threads),
        |row| source.psfs(row),
        |psfs, range| {
            let (Psfs::Stars(_), Some(mut looker)) = (&**psfs, measurer.star_looker()) else {
                return Ok(Vec::new());
            };
            Ok(range.map(|at| looker.look(psfs, at)).collect())
        },
        |looks| {
            if looks.is_empty() {
                return Ok(ControlFlow::Break(()));
            }
            for look in looks {
                survey.add(look);
                if survey.is_over() {
                    return Ok(ControlFlow::Break(()));
                }
            }
            Ok(ControlFlow::Continue(()))
        },
    )?;
    Ok(survey.common())
}

/// Reads `chosen` rows, as many at a time as there are threads, looks at parts of them, and takes what was found in the
/// order of the stamps.
fn scan<R: Send + Sync, L: Send, E: Send>(
    (rows, chosen, threads): (StampRows, &[usize], &impl Threads),
    mut read: impl FnMut(usize) -> Result<R, E>,
    look: impl Fn(&R, Range<usize>) -> Result<L, E> + Send + Sync,
    mut take: impl FnMut(L) -> Result<ControlFlow<()>, E>,
) -> Result<(), E> {
    let together = threads.count().max(1);
    for some in chosen.chunks(together) {
        let read: Vec<(R, usize)> = some
            .iter()
            .map(|&row| Ok((read(row)?, rows.stamps(row).len())))
            .collect::<Result<_, E>>()?;
        let parts = together.div_ceil(read.len());
        let jobs = read.iter().flat_map(|(row, count)| {
            let size = count.div_ceil(parts);
            let starts = (0..*count).step_by(size.max(1));
            starts.map(move |start| (row, start..(start + size).min(*count)))
        });
        for found in threads.map(jobs.collect(), |(row, range)| look(row, range)) {
            if take(found?)?.is_break() {
                return Ok(());
            }
        }
    }
    Ok(())
}
