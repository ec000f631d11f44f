//! The metrics of a scored set: the only place that declares their names and meanings.

#[cfg(feature = "serde")]
use std::collections::BTreeMap;

#[cfg(feature = "serde")]
use serde::{Deserialize, Deserializer, Serialize};

/// Name and meaning of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Metric {
    /// Name in files: columns, keys, conditions.
    pub name: &'static str,
    /// What it measures, in one sentence.
    pub meaning: &'static str,
}

macro_rules! metrics {
    ($($name:ident: $meaning:literal;)+) => {
        /// Metrics of one set or of a replicate of it, or their errors. Not a number if unknown.
        #[derive(Debug, Clone, Copy, PartialEq)]
        #[cfg_attr(feature = "serde", derive(Serialize))]
        #[non_exhaustive]
        pub struct Metrics {
            $(#[doc = $meaning] pub $name: f64,)+
        }

        impl Metrics {
            /// All metrics, in the order of [`Metrics::values`].
            pub const ALL: [Metric; [$($meaning),+].len()] = [$(Metric {
                name: stringify!($name),
                meaning: $meaning,
            }),+];

            /// All values as an array.
            pub fn values(&self) -> [f64; Self::ALL.len()] {
                [$(self.$name),+]
            }

            /// The inverse of [`Metrics::values`].
            pub fn from_values(values: [f64; Self::ALL.len()]) -> Self {
                let [$($name),+] = values;
                Metrics { $($name),+ }
            }
        }
    };
}

metrics! {
    q: "Quality factor, 5·10⁻³/σ_sys.";
    q_dn: "Quality factor after subtracting the power of the noise.";
    q_calibrated: "Quality factor after dividing the spectrum by (1 + m)², with m by cross-correlation: noise and scale-dependent bias remain.";
    m_half: "Multiplicative bias of the power spectrum, halved.";
    sqrt_a: "Additive bias of the power spectrum: sign(A)·√|A| in 10⁻⁴, C_ℓ in steradian.";
    m_cross: "Multiplicative bias by cross-correlation of E modes with the truth.";
    galaxy_noise: "Noise of one galaxy's ellipticity per component, divided by the response 1 + m.";
    m1: "Multiplicative bias of component 1, from the galaxies.";
    m2: "Multiplicative bias of component 2, from the galaxies.";
    c1: "Additive bias of component 1, from the galaxies.";
    c2: "Additive bias of component 2, from the galaxies.";
    b_power: "Mean C_ℓ of the B modes over bins 2 to 9, in 10⁻⁹ steradian.";
    eb_power: "Mean C_ℓ of the EB cross-spectrum over bins 2 to 9, in 10⁻⁹ steradian.";
    sigma_sys_1e4: "σ_sys, the mean distance of the bandpowers from the truth, in 10⁻⁴. Q is 5·10⁻³/σ_sys.";
}

impl Metrics {
    /// The metric that every record contains. Older records lack metrics that were added later.
    pub const ALWAYS: &str = "q";

    /// Index in [`Metrics::values`] of the metric called `name`.
    pub fn place(name: &str) -> Option<usize> {
        Self::ALL.iter().position(|metric| metric.name == name)
    }

    /// No metric is known.
    pub fn unknown() -> Self {
        Self::from_values([f64::NAN; Self::ALL.len()])
    }
}

#[cfg(feature = "serde")]
/// JSON has no NaN: null and absent metrics are read as NaN.
impl<'de> Deserialize<'de> for Metrics {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let found = BTreeMap::<String, Option<f64>>::deserialize(deserializer)?;
        if !found.contains_key(Self::ALWAYS) {
            return Err(serde::de::Error::missing_field(Self::ALWAYS));
        }
        Ok(Self::from_values(Self::ALL.map(
            |Metric { name, .. }| found.get(name).copied().flatten().unwrap_or(f64::NAN),
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_names_and_fields_agree() {
        let values: [f64; Metrics::ALL.len()] = std::array::from_fn(|k| k as f64);
        let metrics = Metrics::from_values(values);
        assert_eq!(metrics.values(), values);
        for (name, field) in [
            ("q", metrics.q),
            ("m_cross", metrics.m_cross),
            ("c2", metrics.c2),
        ] {
            assert_eq!(Metrics::place(name), Some(field as usize));
        }
        assert_eq!(Metrics::place("q_best"), None);
    }

    #[cfg(feature = "serde")]
    #[test]
    fn metrics_that_json_lacks_are_unknown() {
        let metrics = Metrics::from_values(std::array::from_fn(|k| k as f64));
        let text = serde_json::to_string(&metrics).unwrap();
        assert_eq!(serde_json::from_str::<Metrics>(&text).unwrap(), metrics);
        let unknown = serde_json::to_string(&Metrics::unknown()).unwrap();
        assert!(
            serde_json::from_str::<Metrics>(&unknown)
                .unwrap()
                .q
                .is_nan()
        );
        let early: Metrics = serde_json::from_str("{\"q\":1.0}").unwrap();
        assert!(early.q == 1.0 && early.values()[1..].iter().all(|value| value.is_nan()));
        assert!(serde_json::from_str::<Metrics>("{\"q_dn\":1.0}").is_err());
    }
}
