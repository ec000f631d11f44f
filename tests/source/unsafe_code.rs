//! Where code may be `unsafe`: calls of cfitsio, and one of the C library.
//!
//! Crates that use the macro of `multiversion` cannot forbid it, because the macro expands to checked calls of
//! functions with target features. So their text is searched.

use std::fs;

use crate::tree::{CODE, files};

/// Files, or folders of files, with `unsafe`.
const KNOWN: [&str; 2] = [
    "crates/files/src/fits/",
    "src/lib.rs",
];

#[test]
fn unsafe_code_is_where_it_is_known() {
    crate::tree::enter_root();
    let mut found = [false; KNOWN.len()];
    for path in files(&CODE) {
        let name = path.display().to_string();
        let text = fs::read_to_string(&path).unwrap();
        let code = text.lines().map(|line| line.split("//").next().unwrap());
        let is_unsafe = code.clone().any(|line| {
            let mut words = line.split(|c: char| !(c.is_alphanumeric() || c == '_'));
            line.contains("unsafe ")
                && words.any(|word| word == "unsafe")
                && !line.contains("'unsafe-")
        });
        if !is_unsafe {
            continue;
        }
        let place = KNOWN.iter().position(|known| name.starts_with(known));
        let place = place.unwrap_or_else(|| panic!("{name} has unsafe code"));
        found[place] = true;
    }
    assert_eq!(found, [true; KNOWN.len()], "{KNOWN:?}");
}
