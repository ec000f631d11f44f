//! shearq for Python: the module `shearq._shearq`, a thin layer above the crates that measure and score.
//!
//! The package in `python/shearq` checks types and shapes, and names the argument in its errors. Here, arrays become
//! views and errors become exceptions. Only the pipeline and `dataset::threads` start threads, with the interpreter released.

mod bias;
mod command;
mod detect;
mod errors;
mod images;
mod measure;
mod score;
mod select;
mod simulate;
mod stamps;
mod submissions;
mod tables;
mod work;

use pyo3::prelude::*;

#[pymodule]
mod _shearq {
    use pyo3::prelude::*;

    #[pymodule_export]
    use super::bias::{BiasSums, bias_sums, needed_columns};
    #[pymodule_export]
    use super::command::run_command;
    #[pymodule_export]
    use super::detect::{detect, detect_epochs};
    #[pymodule_export]
    use super::images::{
        are_aligned, header_pixels, pixel_difference_of, read_images, stated_oversampling,
    };
    #[pymodule_export]
    use super::measure::{flags, mean_shear, measure, psfs_from_oversampled};
    #[pymodule_export]
    use super::score::{aperture_mass, difference, failed, galaxies, metrics, score, spectrum};
    #[pymodule_export]
    use super::select::select;
    #[pymodule_export]
    use super::simulate::simulate;
    #[pymodule_export]
    use super::submissions::{Configuration, names};
    #[pymodule_export]
    use super::tables::{fingerprint, read_table, write_table};

    /// Version of shearq.
    #[pymodule_export]
    #[expect(non_upper_case_globals, reason = "its name in Python")]
    const __version__: &str = shearq_dataset::VERSION;

    /// The version with its commit is that of the command line. The hook of panics belongs to this module alone: each extension module contains its own standard library.
    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        shearq::silence_caught_panics();
        module.add("version_and_commit", shearq::version_and_commit())
    }
}
