//! The metrics of a scored set. This is the only place that declares them: a new metric is one line in the list below
//! and its value in `SetScorer::metrics`; columns of stores, tables, JSON and baselines follow from the list.

#[cfg(feature = "serde")]
use std::collections::BTreeMap;

#[cfg(feature = "serde")]
use serde::{Deserialize, Deserializer, Serialize};

/// What a metric is called, how it is printed, and where it is found.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct Metric {
    /// Name in files: columns, keys, conditions.
    pub name: &'static str,
    /// Heading in tables, with the power of ten that the values are multiplied by.
    pub heading: &'static str,
    /// Decimals in tables, unless the error determines them.
    pub decimals: usize,
    /// Whether only wide tables contain it.
    pub detail: bool,
    /// What it measures, in one sentence.
    pub meaning: &'static str,
    /// Its value in a record of values, or its error in a record of errors.
    pub value: fn(&Metrics) -> f64,
}

macro_rules! metrics {
    ($($name:ident: $heading:literal, $decimals:literal, $detail:literal, $meaning:literal;)+) => {
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
                heading: $heading,
                decimals: $decimals,
                detail: $detail,
                meaning: $meaning,
                value: |metrics| metrics.$name,
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

// name: heading, decimals, only in wide tables, meaning.
metrics! {
    q: "Q", 2, false, "Quality factor, 5·10⁻³/σ_sys.";
    q_dn: "Q_dn", 2, false, "Quality factor after subtracting the power of the noise.";
    q_calibrated: "Q cal.", 2, false, "Quality factor after dividing the spectrum by (1 + m)², with m by cross-correlation: noise and scale-dependent bias remain.";
    m_half: "M/2", 4, false, "Multiplicative bias of the power spectrum, halved.";
    sqrt_a: "√A×10⁴", 4, false, "Additive bias of the power spectrum: sign(A)·√|A| in 10⁻⁴, C_ℓ in steradian.";
    m_cross: "m (cross)", 4, false, "Multiplicative bias by cross-correlation of E modes with the truth.";
    galaxy_noise: "noise", 4, false, "Noise of one galaxy's ellipticity per component, divided by the response 1 + m.";
    m1: "m1", 4, true, "Multiplicative bias of component 1, from the galaxies.";
    m2: "m2", 4, true, "Multiplicative bias of component 2, from the galaxies.";
    c1: "c1", 5, true, "Additive bias of component 1, from the galaxies.";
    c2: "c2", 5, true, "Additive bias of component 2, from the galaxies.";
    b_power: "B mode×10⁹", 3, true, "Mean C_ℓ of the B modes over bins 2 to 9, in 10⁻⁹ steradian.";
    eb_power: "EB×10⁹", 3, true, "Mean C_ℓ of the EB cross-spectrum over bins 2 to 9, in 10⁻⁹ steradian.";
    sigma_sys_1e4: "σ_sys×10⁴", 4, true, "σ_sys, the mean distance of the bandpowers from the truth, in 10⁻⁴. Q is 5·10⁻³/σ_sys.";
}

impl Metrics {
    /// The metric called `name`.
    pub fn named(name: &str) -> Option<Metric> {
        Self::ALL.into_iter().find(|metric| metric.name == name)
    }

    /// No metric is known.
    pub fn unknown() -> Self {
        Self::from_values([f64::NAN; Self::ALL.len()])
    }
}

#[cfg(feature = "serde")]
/// JSON has no NaN: null is read as NaN.
impl<'de> Deserialize<'de> for Metrics {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let found = BTreeMap::<String, Option<f64>>::deserialize(deserializer)?;
        let mut values = [f64::NAN; Self::ALL.len()];
        for (value, Metric { name, .. }) in values.iter_mut().zip(Self::ALL) {
            let known = found.get(name);
            let known = known.ok_or_else(|| serde::de::Error::missing_field(name))?;
            *value = known.unwrap_or(f64::NAN);
        }
        Ok(Self::from_values(values))
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
        assert_eq!(Metrics::ALL.map(|metric| (metric.value)(&metrics)), values);
        assert_eq!(Metrics::named("c2").unwrap().heading, "c2");
        assert!(Metrics::named("q_best").is_none());
    }

    #[cfg(feature = "serde")]
    #[test]
    fn unknown_metrics_are_null_in_json_and_none_may_lack() {
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
        let lacking = text.replace("\"m1\"", "\"m3\"");
        assert!(serde_json::from_str::<Metrics>(&lacking).is_err());
    }
}
