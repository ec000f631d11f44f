//! Ordered, bounded, parallel mapping: one thread reads, a pool works, and the calling thread writes.
//!
//! Rows of an image share what the reader found in its whole image, so the reader runs ahead of the workers. Files that are
//! independent of each other need [`shearq_dataset::threads`] only.
//!
//! Results reach the writer in the order of reading, for any number of threads. At most `IN_FLIGHT` items per worker
//! exist at a time, so memory does not grow with the length of the work.

use std::any::Any;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};

use shearq_dataset::threads::Pool;

use super::PipelineError;

// Items read, in work or waiting to be written, per worker. Chosen by hand.
const IN_FLIGHT: usize = 4;

/// Hands items to the workers.
#[derive(Debug)]
pub struct Feeder<'a, I> {
    items: SyncSender<(u64, I)>,
    permits: &'a Receiver<()>,
    next: u64,
    ahead: &'a Pool,
}

impl<I> Feeder<'_, I> {
    /// Waits for a free place and hands over `item`; false if the work has ended.
    #[must_use]
    pub fn push(&mut self, item: I) -> bool {
        if self.permits.recv().is_err() {
            return false;
        }
        // Numbered here, because workers finish in any order.
        self.next += 1;
        self.items.send((self.next - 1, item)).is_ok()
    }

    pub fn ahead(&self) -> &Pool {
        self.ahead
    }
}

/// Result of an item; a panic is passed to the calling thread.
type Done<O> = Result<Result<O, PipelineError>, Box<dyn Any + Send>>;

/// Runs `read` on one thread, `work` on `threads` workers with one scratch each, and `write` on the calling thread in
/// the order of reading.
///
/// # Panics
/// If a part panics.
pub fn ordered<I, O, S>(
    threads: usize,
    read: impl FnOnce(&mut Feeder<'_, I>) -> Result<(), PipelineError> + Send,
    scratch: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, I) -> Result<O, PipelineError> + Sync,
    mut write: impl FnMut(O) -> Result<(), PipelineError>,
) -> Result<(), PipelineError>
where
    I: Send,
    O: Send,
{
    // Two pools: the reader surveys whole images on `ahead`, and would wait for ever for workers of `pool`, which wait for the reader.
    let (Pool(pool), ahead) = (Pool::new(threads)?, Pool::new(threads)?);
    let capacity = IN_FLIGHT * threads;
    // The channels of the standard library suffice: an item is a row of stamps, which takes milliseconds.
    let (item_sender, item_receiver) = sync_channel::<(u64, I)>(capacity);
    let (result_sender, result_receiver) = sync_channel::<(u64, Done<O>)>(capacity);
    let (permit_sender, permit_receiver) = sync_channel::<()>(capacity);
    for _ in 0..capacity {
        // Cannot fail: the channel is new and has this capacity.
        let _ = permit_sender.try_send(());
    }
    let items = Mutex::new(item_receiver);
    std::thread::scope(|threads_scope| {
        let ahead = &ahead;
        let reader = threads_scope.spawn(move || {
            let mut feeder = Feeder {
                items: item_sender,
                permits: &permit_receiver,
                next: 0,
                ahead,
            };
            read(&mut feeder)
        });
        let mut outcome = Ok(Ok(()));
        let (work, scratch, items) = (&work, &scratch, &items);
        pool.in_place_scope(|workers| {
            for _ in 0..threads {
                let results = result_sender.clone();
                workers.spawn(move |_| {
                    let mut own = scratch();
                    loop {
                        let next = items.lock().unwrap_or_else(PoisonError::into_inner).recv();
                        let Ok((number, item)) = next else { break };
                        // If a panic ended only this worker, the others would wait for ever.
                        let result = catch_unwind(AssertUnwindSafe(|| work(&mut own, item)));
                        if results.send((number, result)).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(result_sender);
            outcome = collect(&result_receiver, &permit_sender, &mut write);
            // Closed channels end the reader and the workers that wait on them.
            drop(result_receiver);
            drop(permit_sender);
            if !matches!(outcome, Ok(Ok(()))) {
                let waiting = items.lock().unwrap_or_else(PoisonError::into_inner);
                while waiting.recv().is_ok() {}
            }
        });
        match (outcome, reader.join()) {
            (Ok(outcome), Ok(read)) => outcome.and(read),
            (Err(panic), _) | (_, Err(panic)) => resume_unwind(panic),
        }
    })
}

fn collect<O>(
    results: &Receiver<(u64, Done<O>)>,
    permits: &SyncSender<()>,
    write: &mut impl FnMut(O) -> Result<(), PipelineError>,
) -> Done<()> {
    // Bounded by the permits: the reader waits while an early item is not finished.
    let mut early = BTreeMap::new();
    let mut next = 0;
    for (number, result) in results {
        early.insert(number, result);
        while let Some(result) = early.remove(&next) {
            let written = result?.and_then(&mut *write);
            if written.is_err() {
                return Ok(written);
            }
            next += 1;
            // The reader may have finished and gone.
            let _ = permits.try_send(());
        }
    }
    Ok(Ok(()))
}

#[cfg(test)]
mod tests {
    use shearq_measure::Threads;

    use super::*;

    #[test]
    fn results_come_in_order_for_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let mut found = Vec::new();
            ordered(
                threads,
                |feeder| {
                    for k in 0..200u64 {
                        if !feeder.push(k) {
                            break;
                        }
                    }
                    Ok(())
                },
                || 0u64,
                |count, k| {
                    *count += 1;
                    // Uneven work, so that later items finish earlier.
                    std::thread::sleep(std::time::Duration::from_micros(50 * (k % 7)));
                    Ok(k * k)
                },
                |square| {
                    found.push(square);
                    Ok(())
                },
            )
            .unwrap();
            assert_eq!(found, (0..200).map(|k| k * k).collect::<Vec<_>>());
        }
    }

    #[test]
    fn values_mapped_ahead_come_in_order() {
        let mut found = Vec::new();
        ordered(
            3,
            |feeder| {
                for k in 0..5usize {
                    let ahead = feeder.ahead().map((0..40).collect(), |i| i * k);
                    assert_eq!(ahead, (0..40).map(|i| i * k).collect::<Vec<_>>());
                    let _ = feeder.push(ahead[39]);
                }
                Ok(())
            },
            || (),
            |(), k| Ok(k),
            |k| {
                found.push(k);
                Ok(())
            },
        )
        .unwrap();
        assert_eq!(found, [0, 39, 78, 117, 156]);
    }

    #[test]
    fn a_panic_or_an_error_anywhere_ends_the_work() {
        let run = |at: &str| {
            let fails = |place, k| match (at == place && k == 20, at) {
                (true, "panic") => panic!("worker"),
                (true, _) => Err(PipelineError::Interrupted),
                _ => Ok(k),
            };
            let mut written = 0;
            let result = ordered(
                2,
                |feeder| {
                    for k in 0..1000 {
                        if !feeder.push(fails("read", k)?) {
                            break;
                        }
                    }
                    Ok(())
                },
                || (),
                |(), k| fails(if at == "panic" { "panic" } else { "work" }, k),
                |k| {
                    written += 1;
                    fails("write", k).map(|_| ())
                },
            );
            assert!(written <= 21, "{at}: {written}");
            result
        };
        for at in ["read", "work", "write"] {
            assert!(run(at).is_err(), "{at}");
        }
        let panic = catch_unwind(|| run("panic")).unwrap_err();
        assert_eq!(panic.downcast_ref(), Some(&"worker"));
    }
}
