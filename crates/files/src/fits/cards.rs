//! Header cards, read as cfitsio reads them, but before it opens the header. While opening, cfitsio divides by some
//! values and allocates memory for others without checking them.

use std::collections::BTreeMap;
use std::ffi::{c_char, c_int};
use std::ops::RangeInclusive;

use fitsio::sys;

use super::cfitsio::{lock, plain};
use super::source::Source;
use crate::error::FileError;

// Bytes of a header card.
const CARD: usize = 80;
// Bytes of a block of a file.
const BLOCK: usize = 2880;
// Most bytes of a header: fifty thousand cards.
const MAX_HEADER_BYTES: u64 = 1 << 22;
// Longest value that cfitsio has room for.
const LONGEST_VALUE: usize = 70;
// Longest comment that cfitsio has room for.
const LONGEST_COMMENT: usize = 72;
// Number of columns of a table. cfitsio allocates and fills 160 bytes per column while it opens the header.
const COLUMNS: &str = "TFIELDS";
// Most columns of a table in the FITS standard 4.0, section 7.
const MAX_COLUMNS: usize = 999;
// Keys that are kept: the number of columns, and the description of a compressed image; `#` stands for a number.
const KEYS: [&str; 11] = [
    COLUMNS, "ZIMAGE", "ZCMPTYPE", "ZBITPIX", "ZNAXIS", "ZNAXIS#", "ZTILE#", "ZVAL#", "ZNAME#",
    "ZQUANTIZ", "ZDITHER0",
];

/// The [`KEYS`] of a header, by name in capitals, with their values.
pub struct Cards(BTreeMap<String, String>);

impl Cards {
    /// Reads the header that starts at byte `start` of the file; `None` if the file ends there.
    pub fn read(source: &mut Source, start: u64) -> Result<Option<Self>, FileError> {
        let mut cards = BTreeMap::new();
        let mut at = start;
        loop {
            let block = source.read_at(at, BLOCK)?;
            if block.is_empty() && at == start {
                return Ok(None);
            }
            if block.len() < BLOCK || at - start >= MAX_HEADER_BYTES {
                let read = at - start + block.len() as u64;
                let message = format!(
                    "cannot open the file: the header from byte {start} has no END in {read} bytes"
                );
                return Err(FileError::new(source.path(), message));
            }
            for (k, card) in block.chunks_exact(CARD).enumerate() {
                if card.starts_with(b"END     ") {
                    let cards = Cards(cards);
                    cards
                        .number(COLUMNS, 0..=MAX_COLUMNS)
                        .map_err(|message| FileError::new(source.path(), message))?;
                    return Ok(Some(cards));
                }
                let wrong = |what: String| {
                    let byte = at + (k * CARD) as u64;
                    let message = format!("the header card at byte {byte} {what}");
                    FileError::new(source.path(), message)
                };
                let (key, value) = parse(card).map_err(wrong)?;
                if KEYS.contains(&key.replace(|c: char| c.is_ascii_digit(), "#").as_str())
                    || KEYS.contains(&key.as_str())
                {
                    let name = key.clone();
                    if cards.insert(key, value).is_some() {
                        return Err(wrong(format!("is the second one named {name}")));
                    }
                }
            }
            at += BLOCK as u64;
        }
    }

    /// The text of a key, without quotes; `None` if the key is absent.
    pub fn text(&self, key: &str) -> Option<&str> {
        let value = self.0.get(key)?;
        let inner = value.strip_prefix('\'').and_then(|v| v.strip_suffix('\''));
        Some(inner.unwrap_or(value).trim_end())
    }

    /// The whole number of a key, which must be in a range; `None` if the key is absent.
    pub fn number(&self, key: &str, range: RangeInclusive<usize>) -> Result<Option<usize>, String> {
        let Some(value) = self.0.get(key) else {
            return Ok(None);
        };
        let number = value.parse().ok().filter(|number| range.contains(number));
        number.map(Some).ok_or_else(|| {
            let (first, last) = (range.start(), range.end());
            format!("the header key {key} is {value}; expected a whole number, {first} to {last}")
        })
    }
}

fn parse(card: &[u8]) -> Result<(String, String), String> {
    let mut text = [0 as c_char; CARD + 1];
    for (to, from) in text.iter_mut().zip(card) {
        *to = c_char::from_ne_bytes([*from]);
    }
    // Longer than any text of a card.
    let [mut name, mut value, mut comment] = [[0 as c_char; 2 * CARD + 2]; 3];
    let (mut length, mut status): (c_int, c_int) = (0, 0);
    let _guard = lock();
    // SAFETY: the card ends in a zero byte, and each buffer is longer than a card.
    unsafe {
        sys::ffgknm(
            text.as_mut_ptr(),
            name.as_mut_ptr(),
            &mut length,
            &mut status,
        );
        sys::ffpsvc(
            text.as_mut_ptr(),
            value.as_mut_ptr(),
            comment.as_mut_ptr(),
            &mut status,
        );
        sys::ffcmsg();
    }
    let length = |text: &[c_char]| text.iter().take_while(|c| **c != 0).count();
    if length(&value) > LONGEST_VALUE || length(&comment) > LONGEST_COMMENT {
        return Err("has a value or a comment that is too long".into());
    }
    Ok((plain(&name).to_ascii_uppercase(), plain(&value)))
}
