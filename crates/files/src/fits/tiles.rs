//! Tiles of an image that fpack compressed: how it is cut into them, and whether each can be unpacked.

use std::ffi::{CString, c_int};

use fitsio::sys;

use super::cards::Cards;
use super::file::File;
use super::read::{MAX_ROWS as MAX_PLANES, MAX_SIDE};
use super::streams::{self, Coding, Damaged};
use crate::error::FileError;

/// Most pixels of the tiles that lie side by side, which cfitsio keeps all at once: it takes some
/// twenty bytes for each.
const MOST_PIXELS: usize = 1 << 21;
/// Most bytes of a compressed pixel, and of what every tile may have in addition.
const MOST_BYTES: [usize; 2] = [10, 4096];
/// Most rows of the table of cfitsio's random numbers, of which ZDITHER0 is one.
const DITHERS: usize = 10_000;

// Numbers of cfitsio's interface, from its fitsio.h.
const CASEINSEN: c_int = 0;
/// Type codes of columns of arrays of bytes and of 16-bit integers.
const BYTES: c_int = -11;
const SHORTS: c_int = -21;

/// How an image is cut into tiles and compressed, as its header says.
#[derive(Debug)]
pub struct Tiling {
    coding: Coding,
    /// Bytes of a pixel that is a real number.
    real: Option<usize>,
    /// Whether ZQUANTIZ says that real numbers are stored as they are.
    as_they_are: bool,
    /// Columns and rows of the image, or of each plane of a cube.
    sides: [usize; 2],
    /// Planes of a cube, one of an image.
    planes: usize,
    /// Columns and rows of a tile, which is of one plane.
    tile: [usize; 2],
}

impl Tiling {
    /// Of a header; `None` where it is not that of a compressed image.
    ///
    /// # Errors
    /// Where a key is missing or has a value that cfitsio could not work with.
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
                    "the compressed image has {dimensions} dimensions; expected 2, or 3 of a cube"
                ));
            }
        };
        let depth = cards.number("ZTILE3", 1..=MAX_PLANES)?.unwrap_or(1);
        if depth != 1 {
            return Err(format!(
                "its tiles are of {depth} planes each; expected one"
            ));
        }
        let sides = [
            need("ZNAXIS1", 1..=MAX_SIDE)?,
            need("ZNAXIS2", 1..=MAX_SIDE)?,
        ];
        let side =
            |key: &str, absent| Ok::<_, String>(cards.number(key, 1..=MAX_SIDE)?.unwrap_or(absent));
        let tile = [side("ZTILE1", sides[0])?, side("ZTILE2", 1)?];
        let pixels = sides[0].next_multiple_of(tile[0]) * tile[1];
        if pixels > MOST_PIXELS {
            return Err(format!(
                "its tiles of {} × {} pixels have {pixels} in a row of tiles; expected at most {MOST_PIXELS}",
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
            as_they_are: cards.text("ZQUANTIZ") == Some("NONE"),
            sides,
            planes,
            tile,
        }))
    }

    /// Number of tiles.
    fn tiles(&self) -> usize {
        self.of_plane() * self.planes
    }

    /// Number of tiles of a plane.
    fn of_plane(&self) -> usize {
        self.across() * self.sides[1].div_ceil(self.tile[1])
    }

    /// Number of tiles that hold the first `rows` rows, those of a plane following those of the one before.
    fn holding(&self, rows: usize) -> usize {
        let (planes, rest) = (rows / self.sides[1], rows % self.sides[1]);
        planes * self.of_plane() + rest.div_ceil(self.tile[1]) * self.across()
    }

    /// Number of tiles side by side.
    fn across(&self) -> usize {
        self.sides[0].div_ceil(self.tile[0])
    }

    /// Pixels of the tile of a number, from 0: fewer than others at the image's right and upper edge.
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

/// How the tiles are compressed.
fn coding(cards: &Cards) -> Result<Coding, String> {
    match cards.text("ZCMPTYPE") {
        Some("RICE_1" | "RICE_ONE") => rice(cards),
        Some("GZIP_1" | "GZIP_2") => Ok(Coding::Gzip),
        Some("PLIO_1") => Ok(Coding::Plio),
        Some("HCOMPRESS_1") => Ok(Coding::Hcompress),
        found => {
            let found = found.unwrap_or("absent");
            Err(format!(
                "the header key ZCMPTYPE is {found}; expected RICE_1, GZIP_1, GZIP_2, PLIO_1 or HCOMPRESS_1"
            ))
        }
    }
}

/// The parameters of Rice compression: very old files have no size of pixels, or the two exchanged.
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

/// The tiles of a compressed image that is open, checked in their order as they are needed.
pub struct Tiles {
    tiling: Tiling,
    /// Numbers of the columns of data, by [`COLUMNS`]; 0 for one that is not there.
    columns: [c_int; COLUMNS.len()],
    /// Whether real numbers are stored as they are.
    lossless: bool,
    /// Number of tiles that were checked.
    checked: usize,
}

/// Columns that hold a tile: compressed, or what could not be.
const COLUMNS: [&str; 3] = [
    "COMPRESSED_DATA",
    "UNCOMPRESSED_DATA",
    "GZIP_COMPRESSED_DATA",
];

impl Tiles {
    /// Of the image that the file is at.
    ///
    /// # Errors
    /// Where the table of tiles is not one.
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
                    "the column {} does not hold arrays of bytes, or for PLIO_1 of 16-bit integers",
                    COLUMNS[k]
                )));
            }
        }
        let scaled = ["ZSCALE", "ZZERO"]
            .iter()
            .any(|name| column(file, name) != 0);
        let lossless = tiling.as_they_are || tiling.real.is_some() && !scaled;
        if lossless && (tiling.real.is_none() || tiling.coding != Coding::Gzip) {
            let message = if tiling.real.is_some() {
                "real numbers are compressed without being quantised to integers first; expected GZIP_1 or GZIP_2 for that, or quantised ones"
            } else {
                "the header key ZQUANTIZ is NONE for integers; expected it for real numbers (ZBITPIX -32 or -64) alone"
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

    /// Checks all tiles that hold a pixel of the first `rows` rows, as far as they are not.
    ///
    /// # Errors
    /// Where one of them cannot be unpacked.
    pub fn check(&mut self, file: &mut File, rows: usize) -> Result<(), FileError> {
        file.need_all()?;
        let wanted = self.tiling.holding(rows).min(self.tiling.tiles());
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
                        "it says that it takes {length} bytes; expected at most {most}"
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
                Err(damaged("it has more pixels than its place"))
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

/// Number of a column from 1, and 0 where there is none.
fn column(file: &File, name: &str) -> c_int {
    let Ok(name) = CString::new(name) else {
        return 0;
    };
    let mut number = 0;
    // Of several columns of a name cfitsio takes the first, although it calls that an error.
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
