//! Whether the unit that a header states (BUNIT) is one of light.

// Units of light, without prefixes and in capitals.
const LIGHT: [&str; 14] = [
    "ADU",
    "DN",
    "COUNT",
    "COUNTS",
    "CT",
    "CTS",
    "E",
    "ELECTRON",
    "ELECTRONS",
    "PHOTON",
    "PHOTONS",
    "JY",
    "MAGGY",
    "NMGY",
];
const MAGNITUDES: [&str; 5] = ["MAG", "MAGS", "MMAG", "ABMAG", "MAGNITUDE"];
// Prefixes of JY and MAGGY.
const PREFIXES: [&str; 6] = ["", "M", "U", "N", "MICRO", "NANO"];

/// What the pixels are in place of light.
pub(super) fn other_than_light(unit: &str) -> Option<&'static str> {
    let unit = unit.to_ascii_uppercase();
    // Remarks in brackets may name a zero point.
    let before = unit.split('(').next().unwrap_or_default();
    let words = || before.split(|c: char| !c.is_ascii_alphabetic());
    if words().any(|word| MAGNITUDES.contains(&word)) {
        return Some("magnitudes");
    }
    if unit.contains("VARIANCE") {
        return Some("variances");
    }
    // Of "1e-2 (Jy/beam)**2" the text after the number, with the exponents of "e-2" or "adu2".
    let compact: String = unit.chars().filter(|c| !" ^*_".contains(*c)).collect();
    let number = compact.starts_with(|c: char| c.is_ascii_digit());
    let first =
        compact.find(|c: char| c.is_ascii_alphabetic() && !(number && c == 'E') || c == '(');
    let compact = &compact[first?..];
    let (base, power) = match compact
        .strip_prefix('(')
        .and_then(|inner| inner.split_once(')'))
    {
        Some((inner, rest)) => (inner, rest),
        None => compact.split_at(compact.find(|c: char| !c.is_ascii_alphabetic())?),
    };
    let base: String = base.chars().take_while(char::is_ascii_alphabetic).collect();
    let is_light = PREFIXES.iter().any(|prefix| {
        base.strip_prefix(prefix)
            .is_some_and(|rest| LIGHT.contains(&rest))
    });
    // An electron is "e" and "e-".
    let power = if base == "E" {
        power.strip_prefix('-').unwrap_or(power)
    } else {
        power
    };
    let is_inverse = unit.trim_start().starts_with("1/");
    match power {
        _ if !is_light => None,
        _ if power.starts_with('2') && !is_inverse => Some("variances"),
        _ if power.starts_with("-2") || power.starts_with('2') => Some("inverse variances"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn magnitudes_and_variances_are_no_light() {
        for (unit, expected) in [
            ("mag", Some("magnitudes")),
            ("mag/arcsec2", Some("magnitudes")),
            ("mag(AB)", Some("magnitudes")),
            ("electron2", Some("variances")),
            ("ADU**2", Some("variances")),
            ("(Jy/beam)^2", Some("variances")),
            ("e-^2", Some("variances")),
            ("MJy2 / sr2", Some("variances")),
            ("1e-2 nJy ** 2", Some("variances")),
            ("Variance", Some("variances")),
            ("adu**-2", Some("inverse variances")),
            ("1/adu^2", Some("inverse variances")),
            ("count (MAG ZP 25)", None),
            ("", None),
            ("adu", None),
            ("e-", None),
            ("e-/s", None),
            ("ELECTRONS/S", None),
            ("nanomaggy", None),
            ("nmgy", None),
            ("MJy/sr", None),
            ("MJy.sr-1", None),
            ("erg/s/cm2/Angstrom", None),
            ("1e-19 erg/(s cm2 Angstrom)", None),
            ("W m-2 um-1", None),
            ("ct/s", None),
            ("0.00035 uJy", None),
            ("1.0E-2 Jy", None),
        ] {
            assert_eq!(other_than_light(unit), expected, "{unit}");
        }
    }
}
