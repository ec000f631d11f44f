//! How a run of the network went.

/// Why the network stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stop {
    /// No neuron exceeds its threshold.
    Stable,
    /// The next state would not have had a lower energy; which one is kept is a setting.
    EnergyRise,
    /// M iterations were made.
    MaxIterations,
}

impl Stop {
    /// Code in catalogues: 0 stable, 1 energy rise, 2 most iterations.
    pub fn code(self) -> u32 {
        match self {
            Stop::Stable => 0,
            Stop::EnergyRise => 1,
            Stop::MaxIterations => 2,
        }
    }
}

/// How the network went down in energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Descent {
    /// Iterations whose state was accepted, or kept at the end.
    pub iterations: u32,
    /// Why it stopped.
    pub stop: Stop,
    /// E of the first state, in squared image units.
    pub first_energy: f64,
    /// E of the state returned.
    pub energy: f64,
    /// Neurons above their threshold in the last iteration looked at.
    pub updated: u32,
}
