//! Names of files with the numbers of sets and images.

pub const MAX_SET: u32 = 9_999;
pub const MAX_IMAGE: u32 = 999_999;
/// The forms of a number: with at least 1, 2 and 3 digits.
// Numbers in names of GREAT10 are not padded; shearq pads to 2 and 3 digits, subfields of GREAT3 to 3.
pub(crate) const SET_PLACEHOLDERS: [&str; 3] = ["{set}", "{set:02}", "{set:03}"];
pub const IMAGE_PLACEHOLDERS: [&str; 3] = ["{image}", "{image:02}", "{image:03}"];
pub(crate) const PLACEHOLDERS: [[&str; 3]; 2] = [SET_PLACEHOLDERS, IMAGE_PLACEHOLDERS];

pub fn fill(pattern: &str, set: u32, image: u32) -> String {
    let mut filled = pattern.to_owned();
    for (forms, number) in PLACEHOLDERS.into_iter().zip([set, image]) {
        for (form, digits) in forms.into_iter().zip(1..) {
            filled = filled.replace(form, &format!("{number:0digits$}"));
        }
    }
    filled
}

// Further endings of the names of images: of gzip and fpack.
pub(crate) fn endings(pattern: &str) -> &'static [&'static str] {
    match pattern.ends_with(".fits") || pattern.ends_with(".fit") {
        true => &["", ".gz", ".fz"],
        false => &[""],
    }
}

/// Checks that the pattern of `key` has a placeholder of each kind in `needed`, and no other braces.
pub fn check_pattern(key: &str, pattern: &str, needed: &[[&str; 3]]) -> Result<(), String> {
    for one_of in needed {
        if !one_of.iter().any(|name| pattern.contains(name)) {
            return Err(format!(
                "`{key}` is \"{pattern}\"; expected a pattern with {}",
                one_of.join(" or ")
            ));
        }
    }
    let filled = fill(pattern, 1, 1);
    if filled.is_empty() || filled.contains(['{', '}']) {
        return Err(format!(
            "`{key}` is \"{pattern}\"; expected the name of a file, in which only {} stand for numbers",
            PLACEHOLDERS.as_flattened().join(", ")
        ));
    }
    Ok(())
}

// Name of the table of stamps of a gathered image.
pub(crate) const STAMPS: &str = "set{set:02}/stamps-{image:03}.parquet";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_accept_plain_and_padded_numbers() {
        for (pattern, image, expected) in [
            (
                "set{set:02}/galaxies-{image:03}.fits",
                12,
                "set07/galaxies-012.fits",
            ),
            (
                "g10_v1_objs_{set}_{image}.me.dat",
                12,
                "g10_v1_objs_7_12.me.dat",
            ),
            ("image-{set:03}-{image}.fits", 0, "image-007-0.fits"),
        ] {
            assert_eq!(fill(pattern, 7, image), expected);
        }
    }
}
