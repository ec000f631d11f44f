//! End to end, through the binary and the library's public face.

mod baselines;
mod chain;
mod figures;
mod galsim_galaxies;
mod galsim_measured;
mod orientation;
mod packed;
mod reproduced;
mod scoring_cases;
mod shards;
mod stored;
mod submitted;
mod support;
