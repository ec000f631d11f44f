//! shearq for Python: the module `shearq._shearq`, thin doors to the crates that measure and score.
//!
//! What Python hands in is looked at by the package around it (`python/shearq`), which knows how arguments are
//! called; here, arrays become views, requests become those of the crates, and errors become exceptions.
//! Threads are started by `shearq_pipeline::engine` alone, with the interpreter released.

mod command;
mod errors;
mod measure;
mod score;
mod simulate;
mod stamps;
mod submissions;
mod work;

use pyo3::prelude::*;

#[pymodule]
mod _shearq {
    #[pymodule_export]
    use super::command::run_command;
    #[pymodule_export]
    use super::measure::{flags, measure};
    #[pymodule_export]
    use super::score::{difference, metrics, score, spectrum};
    #[pymodule_export]
    use super::simulate::simulate;
    #[pymodule_export]
    use super::submissions::{Configuration, names};

    /// Version of shearq.
    #[pymodule_export]
    #[expect(non_upper_case_globals, reason = "its name in Python")]
    const __version__: &str = shearq_pipeline::VERSION;
}
