//! Patterns of file names with the numbers of sets and images.

pub const MAX_SET: u32 = 9_999;
pub const MAX_IMAGE: u32 = 999_999;

pub(crate) const SET_PLACEHOLDERS: [&str; 2] = ["{set}", "{set:02}"];
pub const IMAGE_PLACEHOLDERS: [&str; 2] = ["{image}", "{image:03}"];
pub(crate) const PLACEHOLDERS: [[&str; 2]; 2] = [SET_PLACEHOLDERS, IMAGE_PLACEHOLDERS];

pub fn fill(pattern: &str, set: u32, image: u32) -> String {
    let [[set_plain, set_padded], [image_plain, image_padded]] = PLACEHOLDERS;
    pattern
        // Any of the two forms, because the files of GREAT10 are not padded and those of shearq are.
        .replace(set_padded, &format!("{set:02}"))
        .replace(image_padded, &format!("{image:03}"))
        .replace(set_plain, &set.to_string())
        .replace(image_plain, &image.to_string())
}

/// Checks that the pattern of `key` has a placeholder of each kind in `needed`, and no other braces.
pub fn check_pattern(key: &str, pattern: &str, needed: &[[&str; 2]]) -> Result<(), String> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_accept_plain_and_padded_numbers() {
        assert_eq!(
            fill("set{set:02}/galaxies-{image:03}.fits", 7, 12),
            "set07/galaxies-012.fits"
        );
        assert_eq!(
            fill("g10_v1_objs_{set}_{image}.me.dat", 7, 12),
            "g10_v1_objs_7_12.me.dat"
        );
    }
}
