//! Work on many files in threads, whose results come back in order and therefore do not depend on the number of threads.

use rayon::iter::{IntoParallelIterator, ParallelIterator};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use shearq_measure::Threads;
use thiserror::Error;

#[derive(Debug, Error)]
#[error("cannot start the worker threads: {0}")]
pub struct ThreadError(#[from] ThreadPoolBuildError);

/// For [`Pool::new`]: one thread per core.
pub const ALL_CORES: usize = 0;

// Items per thread whose results are in memory together. Chosen by hand: threads wait for the slowest item of such a
// batch, and a sum on a 100 × 100 grid has 240 kB.
const IN_MEMORY: usize = 4;

#[derive(Debug)]
pub struct Pool(pub ThreadPool);

impl Pool {
    pub fn new(threads: usize) -> Result<Self, ThreadError> {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build()?;
        Ok(Pool(pool))
    }

    /// Results of `work` on each of `items`, in their order. Items after the last result that the caller takes are worked
    /// on at most to the end of a batch, so an error ends the work soon and memory does not grow with its length.
    pub fn in_order<T: Send, R: Send>(
        &self,
        items: impl IntoIterator<Item = T>,
        work: impl Fn(T) -> R + Sync + Send,
    ) -> impl Iterator<Item = R> {
        let mut items = items.into_iter();
        let batches = std::iter::from_fn(move || {
            let batch: Vec<T> = items.by_ref().take(IN_MEMORY * self.count()).collect();
            (!batch.is_empty()).then(|| self.map(batch, &work))
        });
        batches.flatten()
    }
}

impl Threads for Pool {
    fn count(&self) -> usize {
        self.0.current_num_threads()
    }

    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R> {
        self.0.install(|| of.into_par_iter().map(map).collect())
    }
}

/// Receives the progress of long work, from the thread that called it.
pub trait Progress {
    fn advance(&mut self, galaxies: u64);
    // Galaxies of an earlier call, which must not count for the rate.
    fn skip(&mut self, galaxies: u64) {
        self.advance(galaxies);
    }
    fn note(&mut self, line: &str);
    fn warn(&mut self, line: &str);
}

#[derive(Debug, Clone, Copy, Default)]
pub struct Quiet;

impl Progress for Quiet {
    fn advance(&mut self, _galaxies: u64) {}
    fn note(&mut self, _line: &str) {}
    fn warn(&mut self, _line: &str) {}
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn results_come_in_order_and_the_rest_is_not_worked_on() {
        for threads in [1, 2, 5] {
            let started = AtomicUsize::new(0);
            let pool = Pool::new(threads).unwrap();
            let squares = pool.in_order(0..1000_u64, |k| {
                started.fetch_add(1, Ordering::Relaxed);
                // Uneven work, so that later items finish earlier.
                std::thread::sleep(std::time::Duration::from_micros(50 * (k % 7)));
                k * k
            });
            let found: Vec<u64> = squares.take(100).collect();
            assert_eq!(found, (0..100).map(|k| k * k).collect::<Vec<_>>());
            assert!(started.into_inner() <= 100 + IN_MEMORY * threads);
        }
    }
}
