//! Images that fpack compressed in tiles. Entries of a challenge come from strangers, and cfitsio's decoders do not check
//! their input: they read beyond its end. Each tile is therefore checked here before cfitsio decodes it.

use std::ffi::{CString, c_int};
use std::io::Read;

use fitsio::sys;
use flate2::bufread::GzDecoder;

use super::cards::Cards;
use super::file::File;
use crate::error::FileError;
use crate::table::{MAX_ROWS as MAX_PLANES, MAX_SIDE};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Coding {
    /// RICE_1, with the pixels of a block and the bytes of a pixel: 1, 2 or 4.
    Rice {
        block: usize,
        bytes: usize,
    },
    Gzip,
}

// Most pixels of the tiles next to each other along x, which cfitsio keeps in memory together. It needs some twenty
// bytes per pixel.
const MAX_TILE_ROW_PIXELS: usize = 1 << 21;
// Length of cfitsio's table of random numbers. ZDITHER0 is an index of the table, from 1.
const DITHERS: usize = 10_000;

/// The division of an image into tiles and their compression, as its header describes them.
#[derive(Debug)]
pub struct Tiling {
    coding: Coding,
    /// Bytes per pixel of an image of real numbers; `None` for integers.
    real: Option<usize>,
    /// Whether ZQUANTIZ states that real numbers are stored without quantisation.
    unquantised: bool,
    /// Columns and rows of the image, or of each plane of a cube.
    sides: [usize; 2],
    /// Planes of a cube, 1 for an image.
    planes: usize,
    /// Columns and rows of a tile. A tile has one plane.
    tile: [usize; 2],
}

impl Tiling {
    /// The tiling that a header describes; `None` if it does not describe a compressed image.
    pub fn of(cards: &Cards) -> Result<Option<Self>, String> {
        if cards.text("ZIMAGE").is_none() {
            return Ok(None);
        }
        let need = |key: &str, range| {
            let found = cards.number(key, range)?;
            found.ok_or_else(|| format!("there is no header key {key}; a compressed image has one"))
        };
        let dimensions = need("ZNAXIS", 0..=999)?;
        let planes = match dimensions {
            2 => 1,
            3 => need("ZNAXIS3", 1..=MAX_PLANES)?,
            _ => {
                return Err(format!(
                    "the compressed image has {dimensions} dimensions; expected 2, or 3 for a cube"
                ));
            }
        };
        let depth = cards.number("ZTILE3", 1..=MAX_PLANES)?.unwrap_or(1);
        if depth != 1 {
            return Err(format!("its tiles have {depth} planes each; expected one"));
        }
        let sides = [
            need("ZNAXIS1", 1..=MAX_SIDE)?,
            need("ZNAXIS2", 1..=MAX_SIDE)?,
        ];
        let side =
            |key: &str, absent| Ok::<_, String>(cards.number(key, 1..=MAX_SIDE)?.unwrap_or(absent));
        let tile = [side("ZTILE1", sides[0])?, side("ZTILE2", 1)?];
        let pixels = sides[0].next_multiple_of(tile[0]) * tile[1];
        if pixels > MAX_TILE_ROW_PIXELS {
            return Err(format!(
                "its tiles of {} × {} pixels have {pixels} in a row of tiles; expected at most {MAX_TILE_ROW_PIXELS}",
                tile[0], tile[1]
            ));
        }
        let real = match cards.text("ZBITPIX") {
            Some("8" | "16" | "32") => None,
            Some("-32") => Some(4),
            Some("-64") => Some(8),
            found => {
                let found = found.unwrap_or("absent");
                return Err(format!(
                    "the header key ZBITPIX is {found}; expected 8, 16, 32, -32 or -64"
                ));
            }
        };
        cards.number("ZDITHER0", 1..=DITHERS)?;
        Ok(Some(Tiling {
            coding: coding(cards)?,
            real,
            unquantised: cards.text("ZQUANTIZ") == Some("NONE"),
            sides,
            planes,
            tile,
        }))
    }

    fn tiles(&self) -> usize {
        self.of_plane() * self.planes
    }

    fn of_plane(&self) -> usize {
        self.across() * self.sides[1].div_ceil(self.tile[1])
    }

    /// Number of tiles that contain the first `rows` rows, counted through the planes.
    fn of_rows(&self, rows: usize) -> usize {
        let (planes, rest) = (rows / self.sides[1], rows % self.sides[1]);
        planes * self.of_plane() + rest.div_ceil(self.tile[1]) * self.across()
    }

    /// Number of tiles next to each other along x.
    fn across(&self) -> usize {
        self.sides[0].div_ceil(self.tile[0])
    }

    /// Pixels of the tile with this number, from 0. Tiles at the right and upper edge of the image may be smaller.
    fn pixels(&self, number: usize) -> usize {
        let number = number % self.of_plane();
        let place = [number % self.across(), number / self.across()];
        let side = |axis: usize| {
            let start = place[axis] * self.tile[axis];
            (self.sides[axis] - start).min(self.tile[axis])
        };
        side(0) * side(1)
    }
}

fn coding(cards: &Cards) -> Result<Coding, String> {
    match cards.text("ZCMPTYPE") {
        Some("RICE_1" | "RICE_ONE") => rice(cards),
        Some("GZIP_1" | "GZIP_2") => Ok(Coding::Gzip),
        // cfitsio's decoders of these two write as many pixels as the tile claims. Guarding them takes a decoder of our
        // own, for two formats that no survey uses for galaxy images.
        Some(name @ ("PLIO_1" | "HCOMPRESS_1")) => Err(format!(
            "the image is compressed by {name}; expected RICE_1, GZIP_1 or GZIP_2. Try: funpack"
        )),
        found => {
            let found = found.unwrap_or("absent");
            Err(format!(
                "the header key ZCMPTYPE is {found}; expected RICE_1, GZIP_1 or GZIP_2"
            ))
        }
    }
}

/// The parameters of Rice compression. Very old files lack the pixel size, or have the two exchanged.
fn rice(cards: &Cards) -> Result<Coding, String> {
    const BLOCKS: std::ops::RangeInclusive<usize> = 1..=MAX_SIDE;
    let block = cards.number("ZVAL1", BLOCKS)?;
    let block = block.ok_or("there is no header key ZVAL1; Rice compression has one")?;
    let bytes = match cards.text("ZNAME2") {
        Some("NOISEBIT") => None,
        _ => cards.number("ZVAL2", BLOCKS)?,
    }
    .unwrap_or(4);
    let (block, bytes) = if block < 16 && bytes > 8 {
        (bytes, block)
    } else {
        (block, bytes)
    };
    Ok(Coding::Rice {
        block,
        bytes: if bytes > 2 { 4 } else { bytes },
    })
}

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
