//! Tiles of an image that fpack compressed: whether each can be unpacked.

use std::ffi::{CString, c_int};

use fitsio::sys;

use super::file::File;
use super::streams::{self, Coding, Damaged};
use super::tiling::Tiling;
use crate::error::FileError;

/// Most bytes per compressed pixel, and most further bytes per tile.
const MOST_BYTES: [usize; 2] = [10, 4096];

// Numbers of cfitsio's interface, from its fitsio.h.
const CASEINSEN: c_int = 0;
/// Type codes of columns of arrays of bytes and of 16-bit integers.
const BYTES: c_int = -11;
const SHORTS: c_int = -21;

/// The tiles of an open compressed image. They are checked in order, shortly before cfitsio reads them.
pub struct Tiles {
    tiling: Tiling,
    /// Numbers of the columns of data, in the order of [`COLUMNS`]; 0 for an absent one.
    columns: [c_int; COLUMNS.len()],
    /// Whether real numbers are stored without quantisation.
    lossless: bool,
    /// Number of tiles checked so far.
    checked: usize,
}

/// Columns with the pixels of a tile: compressed, uncompressed, or compressed by gzip without quantisation.
const COLUMNS: [&str; 3] = [
    "COMPRESSED_DATA",
    "UNCOMPRESSED_DATA",
    "GZIP_COMPRESSED_DATA",
];

impl Tiles {
    /// The tiles of the file's current image.
    ///
    /// # Errors
    /// If the columns of the table of tiles are not of the expected types.
    pub fn open(file: &File, tiling: Tiling) -> Result<Self, FileError> {
        let columns = COLUMNS.map(|name| column(file, name));
        let kind = if tiling.coding == Coding::Plio {
            SHORTS
        } else {
            BYTES
        };
        for (k, expected) in [(0, kind), (2, BYTES)] {
            if columns[k] != 0 && file.column_type(columns[k])?.0 != expected {
                return Err(file.fault(format!(
                    "the column {} does not contain arrays of bytes (for PLIO_1: of 16-bit integers)",
                    COLUMNS[k]
                )));
            }
        }
        let scaled = ["ZSCALE", "ZZERO"]
            .iter()
            .any(|name| column(file, name) != 0);
        let lossless = tiling.unquantised || tiling.real.is_some() && !scaled;
        if lossless && (tiling.real.is_none() || tiling.coding != Coding::Gzip) {
            let message = if tiling.real.is_some() {
                "the real numbers are compressed without quantisation; expected GZIP_1 or GZIP_2, or quantised numbers"
            } else {
                "the header key ZQUANTIZ is NONE for integers; expected real numbers (ZBITPIX -32 or -64)"
            };
            return Err(file.fault(message.into()));
        }
        Ok(Tiles {
            tiling,
            columns,
            lossless,
            checked: 0,
        })
    }

    /// Checks all tiles that contain a pixel of the first `rows` rows, unless they were checked before.
    ///
    /// # Errors
    /// If one of them cannot be unpacked.
    pub fn check(&mut self, file: &mut File, rows: usize) -> Result<(), FileError> {
        file.need_all()?;
        let wanted = self.tiling.of_rows(rows).min(self.tiling.tiles());
        while self.checked < wanted {
            self.check_tile(file, self.checked)?;
            self.checked += 1;
        }
        Ok(())
    }

    fn check_tile(&self, file: &File, number: usize) -> Result<(), FileError> {
        let pixels = self.tiling.pixels(number);
        let [compressed, plain, gzip] = self.columns;
        let damaged = |what: &str| {
            file.fault(format!(
                "tile {} of {} is damaged: {what}",
                number + 1,
                self.tiling.tiles()
            ))
        };
        let short =
            |_: Damaged| damaged("its compressed pixels end too early or contradict themselves");
        let length = |column| {
            let length = file.array_length(column, number + 1)?;
            let most = MOST_BYTES[0] * pixels + MOST_BYTES[1];
            usize::try_from(length)
                .ok()
                .filter(|length| *length <= most)
                .ok_or_else(|| {
                    damaged(&format!(
                        "it claims {length} bytes; expected at most {most}"
                    ))
                })
        };
        let size = length(compressed)?;
        if size > 0 {
            let bytes = |words| file.array(compressed, number + 1, words);
            return match self.tiling.coding {
                Coding::Rice { block, bytes: each } => {
                    streams::check_rice(&bytes(size)?, pixels, block, each)
                }
                Coding::Gzip if self.lossless => {
                    streams::check_gzip(&bytes(size)?, pixels, &[self.tiling.real.unwrap_or(4)])
                }
                Coding::Gzip => streams::check_gzip(&bytes(size)?, pixels, &[1, 2, 4]),
                Coding::Plio => streams::check_plio(&file.words(compressed, number + 1, size)?),
                Coding::Hcompress => streams::check_hcompress(&bytes(size)?, pixels),
            }
            .map_err(short);
        }
        if plain != 0 {
            return if length(plain)? <= pixels {
                Ok(())
            } else {
                Err(damaged("it has more pixels than its part of the image"))
            };
        }
        if gzip != 0 {
            let bytes = file.array(gzip, number + 1, length(gzip)?)?;
            return streams::check_gzip(&bytes, pixels, &[self.tiling.real.unwrap_or(4)])
                .map_err(short);
        }
        Err(damaged("it has no pixels"))
    }
}

/// Number of a column, from 1; 0 if there is none.
fn column(file: &File, name: &str) -> c_int {
    let Ok(name) = CString::new(name) else {
        return 0;
    };
    let mut number = 0;
    // If several columns have the name, cfitsio reports an error but uses the first.
    // SAFETY: the file is open, and cfitsio only reads the name.
    let _ = file.call(String::new, |raw, status| unsafe {
        sys::ffgcno(
            raw,
            CASEINSEN,
            name.as_ptr().cast_mut(),
            &mut number,
            status,
        );
    });
    number
}
