//! Images that fpack compressed in tiles. Entries of a challenge come from strangers, and cfitsio's decoders do not check
//! their input: they read beyond its end. Each tile is therefore checked here before cfitsio decodes it.

use std::ffi::{CString, c_int};
use std::io::Read;

use fitsio::sys;
use flate2::bufread::GzDecoder;

use super::file::File;
use super::tiling::{Coding, Tiling};
use crate::error::FileError;

// Most bytes per compressed pixel, and most further bytes per tile.
const MAX_TILE_BYTES: [usize; 2] = [10, 4096];

// Numbers of cfitsio's interface, from its fitsio.h.
const CASEINSEN: c_int = 0;
// Type code of a column of arrays of bytes.
const BYTES: c_int = -11;

/// The tiles of an open compressed image. They are checked in order, shortly before cfitsio reads them.
pub struct Tiles {
    tiling: Tiling,
    /// Numbers of the columns of data, in the order of [`COLUMNS`]; 0 for an absent one.
    columns: [c_int; COLUMNS.len()],
    /// Whether real numbers are stored without quantisation.
    lossless: bool,
    checked: usize,
}

// Columns with the pixels of a tile: compressed, uncompressed, or compressed by gzip without quantisation.
const COLUMNS: [&str; 3] = [
    "COMPRESSED_DATA",
    "UNCOMPRESSED_DATA",
    "GZIP_COMPRESSED_DATA",
];

impl Tiles {
    /// The tiles of the file's current image.
    pub fn open(file: &File, tiling: Tiling) -> Result<Self, FileError> {
        let columns = COLUMNS.map(|name| column(file, name));
        for k in [0, 2] {
            if columns[k] != 0 && file.column_type(columns[k])?.0 != BYTES {
                return Err(file.fault(format!(
                    "the column {} does not contain arrays of bytes",
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
            let most = MAX_TILE_BYTES[0] * pixels + MAX_TILE_BYTES[1];
            usize::try_from(length)
                .ok()
                .filter(|length| *length <= most)
                .ok_or_else(|| {
                    damaged(&format!(
                        "it claims {length} bytes; expected at most {most}"
                    ))
                })
        };
        let array = |column| file.array(column, number + 1, length(column)?);
        let real = [self.tiling.real.unwrap_or(4)];
        if length(compressed)? > 0 {
            let bytes = array(compressed)?;
            return match self.tiling.coding {
                Coding::Rice { block, bytes: each } => check_rice(&bytes, pixels, block, each),
                Coding::Gzip if self.lossless => check_gzip(&bytes, pixels, &real),
                Coding::Gzip => check_gzip(&bytes, pixels, &[1, 2, 4]),
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
            return check_gzip(&array(gzip)?, pixels, &real).map_err(short);
        }
        Err(damaged("it has no pixels"))
    }
}

// Number of a column, from 1; 0 if there is none.
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

// The input ends before the tile does, or contradicts itself.
struct Damaged;

struct Bits<'a> {
    bytes: &'a [u8],
    next: usize,
}

impl Bits<'_> {
    // Least number of valid bits in `Bits::window`.
    const SEEN: u32 = 57;

    fn window(&self) -> u64 {
        let rest = self.bytes.get(self.next / 8..).unwrap_or_default();
        let eight = rest.first_chunk().copied().unwrap_or_else(|| {
            let mut padded = [0; 8];
            padded[..rest.len()].copy_from_slice(rest);
            padded
        });
        u64::from_be_bytes(eight) << (self.next % 8)
    }

    // The next bits, 1 to 8, as a number.
    fn take(&mut self, count: usize) -> Result<usize, Damaged> {
        let value = self.window() >> (64 - count);
        self.skip(count)?;
        Ok(value as usize)
    }

    fn skip(&mut self, count: usize) -> Result<(), Damaged> {
        self.next = self.next.saturating_add(count);
        if self.next <= self.bytes.len() * 8 {
            Ok(())
        } else {
            Err(Damaged)
        }
    }

    fn skip_zeros(&mut self) -> Result<(), Damaged> {
        loop {
            let zeros = self.window().leading_zeros();
            if zeros < Self::SEEN {
                return self.skip(zeros as usize + 1);
            }
            self.skip(Self::SEEN as usize)?;
        }
    }
}

/// Checks a tile of `pixels` pixels compressed by RICE_1.
fn check_rice(
    bytes: &[u8],
    pixels: usize,
    block: usize,
    pixel_bytes: usize,
) -> Result<(), Damaged> {
    // Bits of a block's header, and its value for a block whose differences are stored in full.
    let (width, all) = match pixel_bytes {
        1 => (3, 6),
        2 => (4, 14),
        _ => (5, 25),
    };
    let mut bits = Bits { bytes, next: 0 };
    bits.skip(8 * pixel_bytes)?;
    let mut left = pixels;
    while left > 0 {
        let here = left.min(block);
        match bits.take(width)?.checked_sub(1) {
            None => {}
            Some(low) if low == all => bits.skip(8 * pixel_bytes * here)?,
            Some(low) => {
                for _ in 0..here {
                    bits.skip_zeros()?;
                    bits.skip(low)?;
                }
            }
        }
        left -= here;
    }
    Ok(())
}

/// Checks a tile of `pixels` pixels compressed by gzip, which must unpack to one of `sizes` bytes for
/// each.
fn check_gzip(bytes: &[u8], pixels: usize, sizes: &[usize]) -> Result<(), Damaged> {
    let most = sizes.iter().max().map_or(0, |size| size * pixels) as u64;
    let unpacked = std::io::copy(
        &mut GzDecoder::new(bytes).take(most + 1),
        &mut std::io::sink(),
    )
    .map_err(|_| Damaged)?;
    if sizes.iter().any(|size| (size * pixels) as u64 == unpacked) {
        Ok(())
    } else {
        Err(Damaged)
    }
}
