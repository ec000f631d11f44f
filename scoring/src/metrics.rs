//! The metrics of a scored set, declared once: everything that names, prints or stores them reads this.

use std::collections::BTreeMap;

use serde::{Deserialize, Deserializer, Serialize};

/// What one metric is and how it is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Metric {
    /// Name in files: columns, keys, conditions.
    pub name: &'static str,
    /// Heading of tables, with the unit where there is one.
    pub label: &'static str,
    /// Decimals in tables for people.
    pub decimals: usize,
    /// Whether tables for people leave it out unless they are to be wide.
    pub detail: bool,
    /// What it is, in a sentence.
    pub meaning: &'static str,
}

macro_rules! metrics {
    ($($name:ident: $label:literal, $decimals:literal, $detail:literal, $meaning:literal;)+) => {
        /// Metrics of one set, of a replicate of it, or the errors of them. Not a number where unknown.
        #[derive(Debug, Clone, Copy, PartialEq, Serialize)]
        pub struct Metrics {
            $(#[doc = $meaning] pub $name: f64,)+
        }

        impl Metrics {
            /// What each is, in the order of [`Metrics::values`].
            pub const ALL: [Metric; [$($label),+].len()] = [$(Metric {
                name: stringify!($name),
                label: $label,
                decimals: $decimals,
                detail: $detail,
                meaning: $meaning,
            }),+];

            /// All as an array.
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
    q: "Q", 2, false, "Quality factor, 5·10⁻³/σ_sys.";
    q_dn: "Q_dn", 2, false, "Quality factor after removing the noise's power.";
    q_calibrated: "Q cal.", 2, false, "Quality factor after dividing the spectrum by (1 + m)², m by cross-correlation: what noise and scale-dependent bias leave.";
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
    sigma_sys_1e4: "σ_sys×10⁴", 4, true, "What Q is made of: the mean distance of the bandpowers from the truth, in 10⁻⁴.";
}

impl Metrics {
    /// The metric that all records have. Others are unknown to those that were written before they were thought of.
    pub const ALWAYS: &str = "q";

    /// The place in [`Metrics::values`] of the metric called `name`.
    pub fn place(name: &str) -> Option<usize> {
        Self::ALL.iter().position(|metric| metric.name == name)
    }

    /// None known.
    pub fn unknown() -> Self {
        Self::from_values([f64::NAN; Self::ALL.len()])
    }
}

/// JSON has no NaN: what was written as null is read as that, and so is a metric that is not there.
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
    fn values_names_and_fields_go_together() {
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
